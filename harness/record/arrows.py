"""Force arrows of a recording, drawn at the vertices and hidden until switched on.

Entities: `/scene/forces/<name>`. An arrow's length is proportional to its force. Each force has one scale in a
recording, set by its longest arrow in any frame. That arrow is only known at the end, so arrows are buffered until the
recording is finished or until HELD frames have accumulated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from solvers.problem import Positions

MOST = 200
"""Maximum number of arrows of one force in a frame."""
COLOURS = {"external": 0xF0E442FF, "contact": 0x56B4E9FF}
"""Arrow colour (0xRRGGBBAA) of each force."""
HELD = 2000
"""Number of buffered frames that set the scale; later frames use the same scale."""
_LONGEST = 0.15
"""Length of the longest arrow, as a fraction of the mesh size."""

Points = NDArray[np.float32]
Times = Callable[[NDArray[np.int64]], Iterable[rr.TimeColumn]]


class Arrows:
    """Force arrows on a mesh of a given size [m], in an open recording."""

    def __init__(self, stream: rr.RecordingStream, size: float) -> None:
        self._stream, self._size = stream, size
        self._held: dict[str, list[tuple[int, Points, Points]]] = {}
        self._scale: dict[str, float] = {}  # metres a newton

    def at(self, frame: int, p: Points, forces: Mapping[str, Positions], times: Times) -> None:
        """Buffer the force arrows of one frame.

        Args:
          frame: frame index.
          p: positions (n, 3) [m].
          forces: forces (n, 3) [N] by name; a subset of the vertices is drawn where more than MOST carry a force.
          times: builds the time columns from frame indices.
        """
        for name, force in forces.items():
            acting = np.flatnonzero(np.abs(force).max(axis=1, initial=0.0) > 0.0)
            acting = acting[:: -(-len(acting) // MOST) or 1]
            held = self._held.setdefault(name, [])
            if len(acting) or held or name in self._scale:
                held.append((frame, p[acting], force[acting].astype(np.float32)))
            if len(held) >= HELD:
                self._send(name, times)

    def close(self, times: Times) -> None:
        """Write all buffered arrows."""
        for name in [*self._held]:
            self._send(name, times)

    def _send(self, name: str, times: Times) -> None:
        held = self._held.pop(name)
        if not held:
            return
        frames, origins, forces = zip(*held, strict=True)
        f = np.concatenate(forces)
        entity = f"/scene/forces/{name}"
        if name not in self._scale:
            with np.errstate(over="ignore", invalid="ignore"):
                lengths = np.linalg.norm(f, axis=1)
            longest = float(lengths[np.isfinite(lengths)].max(initial=0.0))
            self._scale[name] = _LONGEST * self._size / longest if longest else 0.0
            look = rr.Arrows3D.from_fields(colors=COLOURS[name], radii=rr.Radius.ui_points(1.25))
            self._stream.log(entity, look, static=True)
        columns = rr.Arrows3D.columns(origins=np.concatenate(origins), vectors=self._scale[name] * f)
        counts = [len(of_frame) for of_frame in origins]
        self._stream.send_columns(entity, times(np.array(frames)), columns.partition(counts))
