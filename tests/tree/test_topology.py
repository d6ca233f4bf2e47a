"""The tree's layout: golden nodes, and one planted corruption for each invariant of the validator."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gi_volumes.tree import bits, build, validate
from gi_volumes.tree.grid import Grid
from gi_volumes.tree.topology import NODE, Topology, link_blocks

sys.path.insert(0, str(Path(__file__).parent))
import meshes


@pytest.fixture(scope="module")
def tree():
    return build.build(meshes.soup(300, 4), Grid(), (0, 0))


@pytest.fixture(scope="module")
def deep():
    return build.build(meshes.soup(40, 4, spread=8.0), Grid(levels=4), (0, 0))


def hand_made():
    """Two first-level voxels: the first with an inner block of two, the second with a block of three leaves."""
    nodes = np.array([(0b11, 2 << 1), (0b111, 4 << 1 | 1), (0, 0), (1 << 63, 7 << 1 | 1)], NODE)
    return Topology((0, 0), (0, 0, 0), (2, 1, 1), nodes, 3)


def test_a_node_has_twelve_bytes_with_the_mask_first():
    assert NODE.itemsize == 12
    assert np.array([(1, 2)], NODE).tobytes() == b"\1\0\0\0\0\0\0\0\2\0\0\0"


def test_a_hand_made_tree_numbers_its_voxels_as_drawn():
    topology = hand_made()
    assert validate.first_defect(topology) is None
    assert topology.size == 8
    level, coords = topology.voxels()
    assert level.tolist() == [0, 0, 1, 1, 1, 1, 1, 2]
    assert coords[2:].tolist() == [[0, 0, 0], [1, 0, 0], [4, 0, 0], [5, 0, 0], [6, 0, 0], [7, 3, 3]]
    terminal = np.array([False, True, False, True])
    np.testing.assert_array_equal(link_blocks(topology.nodes["mask"], terminal, 2), topology.nodes)


@pytest.mark.parametrize("which", ["tree", "deep"])
def test_every_child_is_inside_its_parent_and_every_index_is_used_once(which, request):
    topology = request.getfixturevalue(which)
    assert validate.first_defect(topology) is None
    level, coords = topology.voxels()
    assert (np.diff(level[: len(topology.nodes)].astype(int)) >= 0).all()
    assert len(np.unique(np.concatenate([level[:, None], coords], axis=1), axis=0)) == topology.size
    row, bit = bits.unpack(topology.nodes["mask"])
    child = (topology.nodes["link"][row].astype(np.int64) >> 1) + bits.rank(topology.nodes["mask"][row], bit)
    assert np.array_equal(np.sort(child), np.arange(topology.grid_count, topology.size))
    assert np.array_equal(coords[child] // 4, coords[row])
    assert np.array_equal(level[child], level[row] + 1)
    terminal = topology.nodes["link"][row] & 1 == 1
    assert np.array_equal(terminal, child >= len(topology.nodes))


def node_of(nodes, inner):
    """First node with children, terminal or not."""
    return int(np.flatnonzero((nodes["mask"] != 0) & ((nodes["link"] & 1 == 0) == inner))[0])


def swap_blocks(nodes):
    first, second = np.flatnonzero((nodes["mask"] != 0) & (nodes["link"] & 1 == 1))[:2]
    width = int(bits.popcount(nodes["mask"][second : second + 1])[0])
    nodes["link"][second] = nodes["link"][first]
    nodes["link"][first] = nodes["link"][second] + 2 * width


CORRUPTIONS = {
    "has no children and a terminal bit": lambda n: n["link"].__setitem__(np.argmin(n["mask"] != 0), 1),
    "has no children and a child block offset": lambda n: n["link"].__setitem__(np.argmin(n["mask"] != 0), 40),
    "is terminal and its block of leaves starts within the node array": lambda n: n["link"].__setitem__(
        node_of(n, False), 1
    ),
    "is not terminal and its child block reaches past the node array": lambda n: n["link"].__setitem__(
        node_of(n, False), n["link"][node_of(n, False)] - 1
    ),
    "has a child block within the dense grid": lambda n: n["link"].__setitem__(node_of(n, True), 2),
    "has a child block that reaches past the index space": lambda n: n["link"].__setitem__(
        node_of(n, False), 2**32 - 1
    ),
    "has a child block that does not follow the block before it": swap_blocks,
}


@pytest.mark.parametrize("sentence", CORRUPTIONS)
def test_a_planted_corruption_is_named(sentence, tree):
    nodes = tree.nodes.copy()
    CORRUPTIONS[sentence](nodes)
    assert sentence in validate.first_defect(replace(tree, nodes=nodes))


def test_a_block_at_or_before_its_parent_is_named(deep):
    nodes = deep.nodes.copy()
    inner = np.flatnonzero((nodes["mask"] != 0) & (nodes["link"] & 1 == 0))
    last = int(inner[inner >= deep.grid_count][-1])
    nodes["link"][last] = deep.grid_count << 1
    assert f"node {last} has a child block at or before itself" in validate.first_defect(replace(deep, nodes=nodes))


def test_an_extra_bit_in_any_mask_but_the_last_is_found(tree):
    rng = np.random.default_rng(1)
    with_children = np.flatnonzero(tree.nodes["mask"])[:-1]
    for node in rng.choice(with_children, 40):
        nodes = tree.nodes.copy()
        free = np.flatnonzero(~bits.contains(np.full(64, nodes["mask"][node]), np.arange(64)))
        nodes["mask"][node] |= bits.pack(np.zeros(1, int), free[:1], 1)[0]
        assert validate.first_defect(replace(tree, nodes=nodes)) is not None


def test_every_flipped_bit_of_a_link_is_found(tree):
    node = node_of(tree.nodes, True)
    for bit in range(32):
        nodes = tree.nodes.copy()
        nodes["link"][node] ^= np.uint32(1 << bit)
        assert validate.first_defect(replace(tree, nodes=nodes)) is not None


def test_a_block_of_bare_nodes_is_named():
    nodes = np.array([(0b11, 2 << 1), (0b111, 4 << 1 | 1), (0, 0), (0, 0)], NODE)
    broken = Topology((0, 0), (0, 0, 0), (2, 1, 1), nodes, 3)
    assert "node 0 is not terminal, but none of its children has children" in validate.first_defect(broken)


def test_children_below_the_last_level_are_named():
    assert "node 3 has children below the last level" in validate.first_defect(replace(hand_made(), levels=2))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"grid_shape": (0, 1, 1)}, "is empty"),
        ({"grid_shape": (1 << 40, 1, 1)}, "more voxels than the cap"),
        ({"grid_shape": (2, 2, 2)}, "fewer than the 8 voxels"),
        ({"grid_min": (15, 0, 0)}, "leaves its world cell (0, 0) along x"),
        ({"grid_min": (0, -1, 0)}, "along y"),
        ({"grid_min": (0, 0, 1 << 50)}, "beyond the coordinates"),
        ({"levels": 0}, "0 levels"),
        ({"levels": 9}, "9 levels"),
        ({"nodes": np.zeros(4, np.int64)}, "not one row"),
    ],
)
def test_a_broken_frame_is_named(change, sentence):
    assert sentence in validate.first_defect(replace(hand_made(), **change))


def test_a_tree_over_the_cap_is_named():
    assert "8 data points, more than the cap of 7" in validate.first_defect(hand_made(), 7)
