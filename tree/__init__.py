"""Everything that a bake stores: the voxel tree, its payloads, their files, and the value they define."""
