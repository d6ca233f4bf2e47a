"""Light transport on plain arrays: a scene snapshot goes in, payloads for the voxel tree come out."""
