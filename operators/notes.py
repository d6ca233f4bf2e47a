"""What the snapshot represents otherwise than the scene, gathered while it is read.

Comes in: one call for each place where something was replaced. Goes out: one `Note` for each kind of
replacement, naming the first few places, so that a thousand materials with normal maps make one line.
"""

from __future__ import annotations

from ..bake.snapshot import Note

# Enough names to find the place, few enough for one line of text.
NAMES_SHOWN = 3


class Notes:
    """Replacements made so far.

    Attributes
    ----------
    where : dict
        Places by (what it is, what was used instead), in order of their first appearance.
    """

    def __init__(self) -> None:
        self.where: dict[tuple[str, str], dict[str, None]] = {}

    def add(self, what: str, instead: str, place: str) -> None:
        """Remember a replacement; the same one at the same place counts once.

        Parameters
        ----------
        what : str
            What the scene has, such as "normal map".
        instead : str
            What the snapshot holds, such as "the mesh's own normals".
        place : str
            Where, such as "material 'Brick'".
        """
        self.where.setdefault((what, instead), {})[place] = None

    def record(self) -> tuple[Note, ...]:
        """Return one note for each kind of replacement.

        Returns
        -------
        tuple of Note
            In order of first appearance.
        """
        return tuple(
            Note(f"{what} ({_names(list(places))})", instead) for (what, instead), places in self.where.items()
        )


def _names(places: list[str]) -> str:
    """The first places in words, and how many more there are."""
    shown = ", ".join(places[:NAMES_SHOWN])
    more = len(places) - NAMES_SHOWN
    return f"{shown} and {more} more" if more > 0 else shown
