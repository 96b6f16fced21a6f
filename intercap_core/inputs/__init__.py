"""Files that a user supplies. Readers of all formats use this package.

- ``files``: bytes and text up to a size limit; found values quoted in messages
- ``documents``: JSON, TOML and YAML
- ``arrays``: arrays of .npz archives and pickles

The readers expect damaged files, and execute nothing that a file names. A file that cannot be used
raises :class:`files.UnreadableFile`, a ``UserError`` that names the file.
"""
