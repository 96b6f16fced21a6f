"""Files that a user supplies, read within bounds: the one way in for every reader.

- ``files``: bytes and text of regular files up to a size; links to devices, pipes and folders are
  refused before a byte is read
- ``json_files``, ``yaml_files``: parsed within a depth and a number of values, keys once, whole
  numbers of 64 bits; TOML beside JSON
- ``structure``: how large and deep parsed values are, counted as a reader would meet them
- ``arrays``: .npz archives, whose sizes are compared before memory is taken
- ``numbers``: finite numbers of a shape, or a sentence
- ``quotes``: found values in messages, of bounded length

What is wrong raises :class:`files.Unreadable`, a ``UserError`` that names the file; its ``reason``
fits after a file's name for readers that go on without the file.
"""
