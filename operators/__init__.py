"""What an artist touches in Blender: reading the scene, properties, panels, operators, the command line."""
