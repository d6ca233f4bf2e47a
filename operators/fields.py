"""Values over a surface: constant, or a factor times a picture, or times the mesh's vertex colour.

The algebra keeps what a `Channel` can say exactly (constants times one picture times vertex colour) and paints a
new picture for anything else, texel by texel in numpy. Colours have three components, scalars one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
# Pictures painted from several others are no larger than this along a side [px].
PAINTED_SIZE = 2048


@dataclass(frozen=True)
class Placement:
    """How a picture lies on a mesh.

    `source` names the UV map ("" for the one that renders); see `Texture` for the others.
    """

    source: str = ""
    uv_from_mesh: tuple[float, ...] = IDENTITY
    extension: str = "repeat"
    interpolation: str = "linear"


class Picture:
    """Texels, (h, w, 4) float32 linear, row 0 at v = 0, read when first needed.

    Parameters
    ----------
    name : str
        For messages.
    placement : Placement
        How it lies on meshes.
    load : callable
        Returns the texels.
    image : object or None
        The image that it shows unchanged; None when painted.
    """

    def __init__(self, name: str, placement: Placement, load: Callable[[], np.ndarray], image: object = None) -> None:
        self.name, self.placement, self.image = name, placement, image
        self._load, self._texels = load, None

    @property
    def texels(self) -> np.ndarray:
        """(h, w, 4) float32, linear, not premultiplied."""
        if self._texels is None:
            self._texels = self._load()
        return self._texels


@dataclass(frozen=True)
class Field:
    """`factor` (1 or 3 components) times `channel` of a picture times a vertex colour.

    `vertex_color` names the colour attribute ("" for the one that renders), or is None.
    """

    factor: tuple[float, ...]
    picture: Picture | None = None
    channel: str = "rgb"
    vertex_color: str | None = None

    @property
    def width(self) -> int:
        """Number of components."""
        return len(self.factor)

    @property
    def is_constant(self) -> bool:
        """Whether it is the same everywhere."""
        return self.picture is None and self.vertex_color is None

    def is_value(self, value: float) -> bool:
        """Return whether it is a constant whose components all equal a value.

        Parameters
        ----------
        value : float
            The value.

        Returns
        -------
        bool
            False for pictures and vertex colours.
        """
        return self.is_constant and all(component == value for component in self.factor)

    def mean(self) -> np.ndarray:
        """(width,) float64: the average over the picture, taking vertex colours as white."""
        factor = np.array(self.factor, np.float64)
        return (
            factor if self.picture is None else factor * _read(self).reshape(-1, self.width).mean(0, dtype=np.float64)
        )


def constant(*components: float) -> Field:
    """Return a field that is the same everywhere.

    Parameters
    ----------
    *components : float
        One or three components.

    Returns
    -------
    Field
        The constant.
    """
    return Field(tuple(float(component) for component in components))


def multiply(first: Field, second: Field) -> Field | None:
    """Return a product that needs no painting.

    Parameters
    ----------
    first, second : Field
        Factors; a scalar spreads over a colour's components.

    Returns
    -------
    Field or None
        The product; None when both have a picture, or both a vertex colour, or kinds do not fit.
    """
    width = max(first.width, second.width)
    pictures = [field for field in (first, second) if field.picture is not None]
    vertices = [field for field in (first, second) if field.vertex_color is not None]
    varying = [field for field in (first, second) if not field.is_constant]
    if (
        len(pictures) > 1
        or len(vertices) > 1
        or any(field.vertex_color is not None and field.width != width for field in varying)
    ):
        return None
    factor = tuple((np.broadcast_to(first.factor, width) * np.broadcast_to(second.factor, width)).tolist())
    picture = pictures[0] if pictures else Field(factor)
    vertex = vertices[0].vertex_color if vertices else None
    return Field(factor, picture.picture, picture.channel, vertex)


def component(field: Field, index: int) -> Field | None:
    """Return one component of a colour without painting.

    Parameters
    ----------
    field : Field
        A colour.
    index : int
        0 red, 1 green, 2 blue.

    Returns
    -------
    Field or None
        A scalar; None when a vertex colour is part of it.
    """
    if field.vertex_color is not None:
        return None
    channel = "rgb"[index] if field.channel == "rgb" else field.channel
    return replace(field, factor=(field.factor[index],), channel=channel)


def paint(function: Callable[..., np.ndarray], inputs: list[Field], width: int, name: str) -> Field:
    """Return a function of fields, painted where any input has a picture.

    Parameters
    ----------
    function : callable
        Takes one (h, w, c) float array for each input, broadcastable, and returns (h, w, width).
    inputs : list of Field
        Without vertex colours; pictures of one placement.
    width : int
        Components of the result.
    name : str
        Of the new picture.

    Returns
    -------
    Field
        A constant when all inputs are.
    """
    with np.errstate(all="ignore"):
        if all(field.picture is None for field in inputs):
            value = function(*(np.array(field.factor, np.float64).reshape(1, 1, -1) for field in inputs))
            return Field(tuple(np.nan_to_num(np.broadcast_to(value, (1, 1, width))[0, 0]).tolist()))
        pictures = [field.picture for field in inputs if field.picture is not None]
        height, breadth = (min(max(p.texels.shape[axis] for p in pictures), PAINTED_SIZE) for axis in (0, 1))
        value = function(*(_resampled(field, height, breadth) for field in inputs))
    texels = np.ones((height, breadth, 4), np.float32)
    texels[..., :3] = np.nan_to_num(np.broadcast_to(value, (height, breadth, width)), posinf=65504.0, neginf=-65504.0)
    picture = Picture(name, pictures[0].placement, lambda: texels)
    return Field((1.0,) * width, picture, "rgb" if width == 3 else "r")


def _read(field: Field) -> np.ndarray:
    """(h, w, width) texels of a field's picture, without its factor."""
    texels = field.picture.texels
    if field.channel != "rgb":
        plane = "rgba".index(field.channel)
        return np.broadcast_to(texels[..., plane : plane + 1], (*texels.shape[:2], field.width))
    return texels[..., :3] if field.width == 3 else (texels[..., :3] @ LUMINANCE.astype(np.float32))[..., None]


def _resampled(field: Field, height: int, breadth: int) -> np.ndarray:
    """(height, breadth, width) values, by the nearest texel; (1, 1, width) for a constant."""
    factor = np.array(field.factor, np.float32)
    if field.picture is None:
        return factor.reshape(1, 1, -1)
    texels = _read(field)
    if texels.shape[:2] != (height, breadth):
        rows = (np.arange(height) * texels.shape[0]) // height
        columns = (np.arange(breadth) * texels.shape[1]) // breadth
        texels = texels[rows[:, None], columns]
    return texels * factor
