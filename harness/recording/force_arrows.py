"""Force arrows of a recording, drawn at the vertices and hidden until switched on.

Entities: `/scene/forces/<name>`. An arrow's length is proportional to its force. Each force has one scale in a
recording, set by its longest arrow in any frame. That arrow is only known at the end, so arrows are buffered until the
recording is finished or until MAX_BUFFERED_FRAMES frames have accumulated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from springbench.solvers.model.step_problem import Positions

MAX_ARROWS = 200
"""Maximum number of arrows of one force in a frame."""
FORCE_COLOURS = {"external": 0xF0E442FF, "contact": 0x56B4E9FF}
"""Arrow colour (0xRRGGBBAA) of each force."""
MAX_BUFFERED_FRAMES = 2000
"""Number of buffered frames that set the scale; later frames use the same scale."""
_MAX_LENGTH_FRACTION = 0.15
"""Length of the longest arrow, as a fraction of the mesh size."""

PointArray = NDArray[np.float32]
TimeIndex = Callable[[NDArray[np.int64]], Iterable[rr.TimeColumn]]


class ForceArrows:
    """Force arrows on a mesh of a given size [m], in an open recording."""

    def __init__(self, stream: rr.RecordingStream, size: float) -> None:
        self._stream, self._size = stream, size
        self._pending: dict[str, list[tuple[int, PointArray, PointArray]]] = {}
        self._scale: dict[str, float] = {}  # metres per newton

    def add_frame(self, frame: int, p: PointArray, forces: Mapping[str, Positions], times: TimeIndex) -> None:
        """Buffer the force arrows of one frame.

        Args:
            frame: frame index.
            p: positions (n, 3) [m].
            forces: forces (n, 3) [N] by name; of more than MAX_ARROWS vertices with a force, a subset is drawn.
            times: builds the time columns from frame indices.
        """
        for name, force in forces.items():
            acting = np.flatnonzero(np.abs(force).max(axis=1, initial=0.0) > 0.0)
            acting = acting[:: -(-len(acting) // MAX_ARROWS) or 1]
            pending = self._pending.setdefault(name, [])
            if len(acting) or pending or name in self._scale:
                pending.append((frame, p[acting], force[acting].astype(np.float32)))
            if len(pending) >= MAX_BUFFERED_FRAMES:
                self._send_forces(name, times)

    def close(self, times: TimeIndex) -> None:
        """Write all buffered arrows."""
        for name in [*self._pending]:
            self._send_forces(name, times)

    def _send_forces(self, name: str, times: TimeIndex) -> None:
        pending = self._pending.pop(name)
        if not pending:
            return
        frames, origins, forces = zip(*pending, strict=True)
        f = np.concatenate(forces)
        entity = f"/scene/forces/{name}"
        if name not in self._scale:
            with np.errstate(over="ignore", invalid="ignore"):
                lengths = np.linalg.norm(f, axis=1)
            longest = float(lengths[np.isfinite(lengths)].max(initial=0.0))
            self._scale[name] = _MAX_LENGTH_FRACTION * self._size / longest if longest else 0.0
            look = rr.Arrows3D.from_fields(colors=FORCE_COLOURS[name], radii=rr.Radius.ui_points(1.25))
            self._stream.log(entity, look, static=True)
        columns = rr.Arrows3D.columns(origins=np.concatenate(origins), vectors=self._scale[name] * f)
        counts = [len(of_frame) for of_frame in origins]
        self._stream.send_columns(entity, times(np.array(frames)), columns.partition(counts))
