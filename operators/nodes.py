"""Finding one's way in node graphs: what feeds a socket, through reroutes, muted nodes and groups.

Comes in: a socket, and the groups it was reached through. Goes out: the output that feeds it or, where nothing
does, the socket that holds the constant.
"""

from __future__ import annotations

from typing import NamedTuple

import bpy

MAX_STEPS = 10000


class Place(NamedTuple):
    """A socket, seen through the group nodes in `groups` (outermost first)."""

    socket: bpy.types.NodeSocket
    groups: tuple = ()


class Graph:
    """Navigation with the links of each tree looked up once (`socket.links` searches all links at each call)."""

    def __init__(self) -> None:
        self._links: dict[int, dict[int, bpy.types.NodeLink]] = {}

    def resolve(self, place: Place) -> Place:
        """Return the output that feeds an input or, where it is unlinked, the input that holds its constant.

        Parameters
        ----------
        place : Place
            An input socket.

        Returns
        -------
        Place
            An output of a node that computes something, or an unlinked input.
        """
        for _ in range(MAX_STEPS):
            link = self._link(place.socket)
            if link is None:
                return place
            step = self._through(Place(link.from_socket, place.groups))
            if step.socket.is_output or step == place:
                return step
            place = step
        return place

    def _through(self, place: Place) -> Place:
        """Where an output's value comes from: itself, or the input that it merely passes on."""
        node = place.socket.node
        if node.mute and node.type != "REROUTE":
            inner = [link.from_socket for link in node.internal_links if link.to_socket == place.socket]
            return Place(inner[0], place.groups) if inner else place
        if node.type == "REROUTE":
            return Place(node.inputs[0], place.groups)
        if node.type == "GROUP" and node.node_tree is not None:
            output = _group_output(node.node_tree)
            inner = _named(output.inputs, place.socket) if output is not None else None
            return Place(inner, (*place.groups, node)) if inner is not None else place
        if node.type == "GROUP_INPUT" and place.groups:
            outer = _named(place.groups[-1].inputs, place.socket)
            return Place(outer, place.groups[:-1]) if outer is not None else place
        return place

    def _link(self, socket: bpy.types.NodeSocket) -> bpy.types.NodeLink | None:
        """The link into an input."""
        tree = socket.id_data
        key = tree.as_pointer()
        if key not in self._links:
            self._links[key] = {
                link.to_socket.as_pointer(): link for link in tree.links if link.is_valid and not link.is_muted
            }
        return self._links[key].get(socket.as_pointer())


def named(node: bpy.types.Node, *names: str) -> bpy.types.NodeSocket | None:
    """Return the first enabled input that has one of the given names.

    Parameters
    ----------
    node : bpy.types.Node
        The node.
    *names : str
        Names in order of preference: sockets are renamed between versions of Blender.

    Returns
    -------
    bpy.types.NodeSocket or None
        The input.
    """
    for name in names:
        for socket in node.inputs:
            if socket.name == name and socket.enabled:
                return socket
    return None


def _group_output(tree: bpy.types.NodeTree) -> bpy.types.Node | None:
    """The output node that counts."""
    outputs = [node for node in tree.nodes if node.type == "GROUP_OUTPUT"]
    active = [node for node in outputs if node.is_active_output]
    return (active or outputs or [None])[0]


def _named(sockets, like: bpy.types.NodeSocket) -> bpy.types.NodeSocket | None:
    """The socket of the same identifier, on the other side of a group's border."""
    return next((socket for socket in sockets if socket.identifier == like.identifier), None)
