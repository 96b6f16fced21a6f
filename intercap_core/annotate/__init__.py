"""Mend a sequence's annotation in the browser: see the result over the images, fix it, run again.

``server`` gives the page in ``page/`` what ``sequence``, ``images``, ``result`` and ``snap`` read
of the results, and keeps what is answered by ``document``, ``questions`` and ``rerun``.
"""
