"""Shape of an object from a multi-camera RGB-D recording of a person who turns it.

- ``surfaces``: depth pixels that show the object, in each frame set.
- ``handled``: the object that moves, among the parts that the candidates show.
- ``alignment``: poses of the frame sets around the first one, by registration of points.
- ``volume``: signed distance field of depth images, and its closed surface.
- ``fusion``: the field and the colours of recordings with known poses.
- ``proposal``: standing frame and symmetry of the mesh.
- ``result``: the finished mesh and its figures.

``commands/scan.py`` calls them in order and tracks the object with the stage ``object_track``.
"""
