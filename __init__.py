"""GI Volumes: bakes and previews global-illumination volumes.

The folder of this file is both a Blender extension and the Python package
`gi_volumes`. Importing it is cheap and needs neither Blender nor numpy.
"""

VERSION = "0.1.0"
