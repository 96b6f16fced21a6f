"""Shape of an object from a multi-camera RGB-D recording of a person who turns it.

- ``surfaces``: depth pixels that show the object, in each frame set.
- ``alignment``: poses of the object, by registration of each frame set to the model of all others.
- ``volume``: fusion of the depth images into a signed distance field, and its closed surface.
- ``proposal``: standing frame and symmetry of the mesh.
- ``object_scan``: the steps in order; entry of the package.
"""
