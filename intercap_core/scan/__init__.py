"""Shape of an object from RGB-D recordings: a person turns it, or a camera is carried around it.

- ``surfaces``: depth pixels that show the object, in each frame set.
- ``handled``: the object that moves, among the parts that the candidates show.
- ``alignment``: poses of the frame sets around the first one, by registration of points.
- ``multiview``: poses that align all of these together, without drift.
- ``volume``: signed distance field of depth images, and its closed surface.
- ``fusion``: the field and the colours of recordings with known poses.
- ``walk``: poses of one camera that is carried through a scene at rest.
- ``standing``: the object on a plane, among the surfaces of a walk.
- ``proposal``: standing frame and symmetry of the mesh.
- ``result``: the finished mesh and its figures.

``commands/scan.py`` calls them in order and tracks a turned object with the stage
``object_track``.
"""
