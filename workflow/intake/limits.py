"""What files from outside may hold at most (SECURITY.md#limits). Beyond it they are refused before anything is allocated.

Each limit is above what real captures have, and below what a machine of 16 GB survives. The length of names is in
`workflow.intake.names`, because every stage depends on that.
"""

PICTURE_PIXELS = 128_000_000
"""Pixels of a photograph, mask, map or texture. The largest cameras in use have 102 million; a photograph takes about 25 bytes a
pixel of memory while it is reduced."""
PICTURE_VALUES = 4 * PICTURE_PIXELS
"""Pixels times channels of an EXR: four full channels, or more in a smaller picture."""
PICTURE_CHANNELS = 256
"""Channels of an EXR."""
MESH_BYTES = 4 << 30
"""Size of a mesh file. A scan of 30 million triangles has 0.6 GB in binary form."""
MESH_ELEMENTS = 50_000_000
"""Vertices of a mesh, or faces of it."""
INSERT_FACES = 2_000_000
"""Faces of a mesh that is put into a room."""
DOCUMENT_BYTES = 128 << 20
"""Size of a JSON or text document. The segments of a large scan have 20 MB."""
MODEL_BYTES = 4 << 30
"""Size of a file of a COLMAP model."""
FRAMES = 100_000
"""Photographs that a list of cameras may name."""
KEYS = 1_000
"""Different keys of a list of cameras."""
SETTINGS_BYTES = 1 << 20
"""Size of a YAML file. The largest that is shipped has 20 kB."""
SETTINGS_NODES = 20_000
"""Keys and values of a YAML file, with what its anchors stand for counted each time."""
SETTINGS_DEPTH = 32
"""Levels of a YAML file."""
TABLE_BYTES = 16 << 20
"""Size of a table in text form: of scenes, or of a camera response."""
TABLE_ROWS = 1 << 16
"""Rows of a camera response."""
ARRAY_BYTES = 256 << 20
"""Size of an array of NumPy: of a camera response, or of exposures."""
TEXT = 4_096
"""Characters of a path, or of any other text of a file name."""
NUMBER = 1e12
"""Magnitude of a number: of a length, a focal length, an exposure, a setting."""
RADIANCE = 1e9
"""Radiance, or a factor on it; pictures are single floats, which end at 3e38."""
FOCAL = (0.01, 1_000.0)
"""Focal length as a share of the longer side of the picture."""
GAIN = (1e-9, 1e9)
"""Exposure of a photograph."""
