"""Small Blender scenes for the tests that read them."""

from __future__ import annotations

import math

import numpy as np
import pytest


class Studio:
    """Makes what a scene is built of; everything is in metres."""

    def __init__(self, bpy) -> None:
        self.bpy = bpy

    @property
    def scene(self):
        return self.bpy.context.scene

    def mesh(self, name="mesh", corners=((0, 0, 0), (1, 0, 0), (0, 1, 0)), faces=((0, 1, 2),), uv=True):
        """A mesh whose UVs are its corners' x and y."""
        mesh = self.bpy.data.meshes.new(name)
        mesh.from_pydata(corners, [], faces)
        if uv:
            layer = mesh.uv_layers.new(name="UVMap")
            for loop in mesh.loops:
                layer.data[loop.index].uv = corners[loop.vertex_index][:2]
        return mesh

    def cube(self):
        """A closed cube of side 2 whose faces look outwards."""
        corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        return self.mesh("cube", corners, faces, uv=False)

    def place(self, data, name="object", location=(0, 0, 0), scale=(1, 1, 1), rotation=(0, 0, 0), parent=None):
        """An object in the scene."""
        placed = self.bpy.data.objects.new(name, data)
        placed.location, placed.scale, placed.rotation_euler = location, scale, rotation
        placed.parent = parent
        self.scene.collection.objects.link(placed)
        return placed

    def lamp(self, kind, name="lamp", location=(0, 0, 0), scale=(1, 1, 1), rotation=(0, 0, 0), **settings):
        """A lamp in the scene."""
        light = self.bpy.data.lights.new(name, kind)
        for key, value in settings.items():
            setattr(light, key, value)
        return self.place(light, name, location, scale, rotation)

    def material(self, name="material"):
        """A material with an output and nothing else."""
        material = self.bpy.data.materials.new(name)
        return self._empty(material, "ShaderNodeOutputMaterial")

    def world(self, name="world"):
        """A world with an output and nothing else, in use."""
        self.scene.world = self._empty(self.bpy.data.worlds.new(name), "ShaderNodeOutputWorld")
        return self.scene.world

    def _empty(self, owner, output):
        if self.bpy.app.version < (5, 0, 0):
            owner.use_nodes = True
        owner.node_tree.nodes.clear()
        owner.node_tree.nodes.new(output)
        return owner

    def node(self, owner, kind, settings=None, **inputs):
        """A node; inputs by position (`_0`) or name (spaces as `_`): constants, or (node, output) to link."""
        tree = getattr(owner, "node_tree", owner)
        node = tree.nodes.new(kind)
        for key, value in (settings or {}).items():
            setattr(node, key, value)
        for key, value in inputs.items():
            enabled = [socket for socket in node.inputs if socket.name == key.replace("_", " ") and socket.enabled]
            socket = node.inputs[int(key[1:])] if key[1:].isdigit() else enabled[0]
            if isinstance(value, tuple) and isinstance(value[0], self.bpy.types.Node):
                tree.links.new(value[0].outputs[value[1]], socket)
            elif isinstance(value, self.bpy.types.Node):
                tree.links.new(next(output for output in value.outputs if output.enabled), socket)
            else:
                socket.default_value = value
        return node

    def surface(self, owner, node, output=0):
        """Connect a shader to the output."""
        owner.node_tree.links.new(node.outputs[output], owner.node_tree.nodes[0].inputs["Surface"])

    def image(self, pixels, name="image", space="sRGB", floats=False):
        """An image of (h, w, 4) values as stored, row 0 at the bottom."""
        pixels = np.asarray(pixels, np.float32)
        image = self.bpy.data.images.new(name, pixels.shape[1], pixels.shape[0], alpha=True, float_buffer=floats)
        image.colorspace_settings.name = space
        image.pixels.foreach_set(np.ascontiguousarray(pixels).ravel())
        image.update()
        return image

    def wear(self, *materials, mesh=None):
        """A triangle in the scene that wears materials."""
        mesh = mesh or self.mesh()
        for material in materials:
            mesh.materials.append(material)
        return self.place(mesh, "worn")

    def counts(self):
        """Number of data-blocks of each kind."""
        data = self.bpy.data
        kinds = [p.identifier for p in data.bl_rna.properties if p.type == "COLLECTION"]
        return {kind: len(getattr(data, kind)) for kind in kinds}

    def irradiance(self, samples=32, at=(0.0, 0.0), size=0.01):
        """(3,) what Cycles says arrives at the origin's plane, facing up [W/m2]: pi times a white plane's radiance."""
        bpy, scene = self.bpy, self.scene
        white = self.material("white")
        self.surface(white, self.node(white, "ShaderNodeBsdfDiffuse", Color=(1, 1, 1, 1)))
        half = size / 2
        corners = [(at[0] + x, at[1] + y, 0) for x, y in ((-half, -half), (half, -half), (half, half), (-half, half))]
        plane = self.wear(white, mesh=self.mesh("probe", corners, ((0, 1, 2, 3),)))
        camera = bpy.data.cameras.new("probe")
        camera.type, camera.ortho_scale, camera.clip_start = "ORTHO", half, 1e-4
        scene.camera = self.place(camera, "probe camera", (*at, 1e-3))
        scene.render.engine = "CYCLES"
        cycles = scene.cycles
        cycles.samples, cycles.max_bounces, cycles.use_denoising = samples, 0, False
        cycles.use_adaptive_sampling = False
        cycles.sample_clamp_direct = 0
        scene.render.resolution_x = scene.render.resolution_y = 8
        scene.render.resolution_percentage = 100
        pixels = self.rendered(scene)
        bpy.data.objects.remove(plane)
        return pixels.reshape(-1, 3).mean(0, dtype=np.float64) * math.pi

    def rendered(self, scene):
        """(h, w, 3) float32 of a render."""
        from gi_volumes.operators import sky

        settings = scene.render.image_settings
        if hasattr(settings, "media_type"):
            settings.media_type = "IMAGE"
        settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGB", "32"
        scene.render.filepath = self.bpy.app.tempdir + "picture.exr"
        self.bpy.ops.render.render(write_still=True)
        return sky._pixels(scene.render.filepath, scene.render.resolution_x, scene.render.resolution_y)


@pytest.fixture
def studio():
    """An empty scene in a fresh Blender."""
    bpy = pytest.importorskip("bpy")
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    return Studio(bpy)


@pytest.fixture
def extract(studio):
    """Read what is open."""
    from gi_volumes.operators import extract as module

    return lambda: module.extract(studio.bpy.context)
