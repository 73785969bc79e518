"""Coefficients of explicit methods, and properties that follow from them.

Splitting methods alternate drifts a and kicks b, a_0 b_0 a_1 ... b_(k-1) a_k, and are symmetric (Blanes and Moan 2002,
"Practical symplectic partitioned Runge-Kutta and Runge-Kutta-Nystrom methods", S6 of order 4 and S10 of order 6). The
Runge-Kutta methods are Kutta's of order 4; Tsitouras 2011, "Runge-Kutta pairs of order 5(4) satisfying only the first
column simplifying assumption"; and Dormand and Prince's of order 8, with errors of order 5 and 3 (Hairer, Norsett and
Wanner, Solving Ordinary Differential Equations I, section II.5).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SplittingMethod:
    """A splitting method.

    Its drifts (k + 1,) and kicks (k,) are fractions of a step.
    """

    order: int
    drifts: FloatArray
    kicks: FloatArray

    @classmethod
    def from_first_half(cls, order: int, drifts: list[float], kicks: list[float]) -> SplittingMethod:
        """Build a symmetric method from its first half; the middle coefficients complete the sums.

        Args:
            order: order of the method.
            drifts: drifts before the middle one, as fractions of a step.
            kicks: kicks of the first half without its last one, as fractions of a step.
        """
        middle = 1.0 - 2.0 * sum(drifts)
        kicks = [*kicks, 0.5 - sum(kicks)]
        return cls(order, np.array([*drifts, middle, *drifts[::-1]]), np.array([*kicks, *kicks[::-1]]))

    @property
    def num_evaluations(self) -> int:
        """Evaluations of the forces per step; a first drift of zero reuses the last evaluation."""
        return len(self.kicks) - (self.drifts[0] == 0.0)

    def compute_growth(self, y: FloatArray) -> FloatArray:
        """Return the spectral radius of a step for oscillators with omega h = y (k,)."""
        step = np.broadcast_to(np.eye(2), (len(y), 2, 2))
        drift, kick = np.zeros((2, *step.shape)) + np.eye(2)
        for k, length in enumerate(self.drifts):
            drift[:, 0, 1] = length * y
            step = drift @ step
            if k < len(self.kicks):
                kick[:, 1, 0] = -self.kicks[k] * y
                step = kick @ step
        return np.abs(np.linalg.eigvals(step)).max(axis=1)

    @cached_property
    def stability_limit(self) -> float:
        """Stability limit of omega h."""
        return _find_stability_limit(self)


@dataclass(frozen=True, eq=False)
class ExplicitTableau:
    """An explicit Runge-Kutta method.

    Attributes:
        order: order of the method.
        a: rows of the tableau (s, s); the last one ends the step.
        error_weights: weights of the error estimates (0 to 2, s).
        error_exponent: exponent of the step size in the error.
    """

    order: int
    a: FloatArray
    error_weights: FloatArray
    error_exponent: float = 0.0

    @property
    def num_evaluations(self) -> int:
        """Evaluations of the forces per step."""
        return len(self.a) - 1

    def compute_growth(self, y: FloatArray) -> FloatArray:
        """Return the magnitude of the stability function, |R(i y)|, for y (k,)."""
        s = len(self.a)
        stages = np.linalg.solve(np.eye(s) - 1j * y[:, None, None] * self.a, np.ones((s, 1)))
        return np.abs(stages[:, -1, 0])

    @cached_property
    def stage_times(self) -> FloatArray:
        """Times c of the stages (s,)."""
        return self.a.sum(axis=1)

    @cached_property
    def stability_limit(self) -> float:
        """Stability limit of omega h."""
        return _find_stability_limit(self)


_MAX_TRIED_RATIO = 20
"""Maximum ratio of tried steps to the stable number with an error tolerance; 10,000 more are allowed."""


def compute_max_steps(count: int, tolerance: float) -> int:
    """Return the maximum number of steps to try in a frame.

    Args:
        count: stable number of fixed steps.
        tolerance: error tolerance of a step [m]; 0 for exactly `count` steps.
    """
    return _MAX_TRIED_RATIO * count + 10_000 if tolerance else count


def integrate_drag(kicks: FloatArray, h: float, drag: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the decay and the gain of a velocity by each kick, both (k, r).

    The gain is per acceleration [s]. Both are exact for linear drag.

    Args:
        kicks: fractions of a step (k,).
        h: step size [s].
        drag: (r,) [1/s].
    """
    gone = h * kicks[:, None] * drag
    gained = np.divide(-np.expm1(-gone), drag, out=h * kicks[:, None] + 0.0 * gone, where=drag > 0)
    return np.exp(-gone), gained


def _find_stability_limit(method: SplittingMethod | ExplicitTableau) -> float:
    for tried in np.array_split(np.arange(0.01, 40.0, 0.01), 20):
        if len(found := np.flatnonzero(method.compute_growth(tried) > 1.0 + 1e-6)):
            return float(tried[found[0]]) - 0.01
    raise ValueError("the method is stable for all tried steps")


def _lower_triangular(*rows: list[float]) -> FloatArray:
    """Build a square array from rows padded with zeros."""
    out = np.zeros((len(rows), len(rows)))
    for k, row in enumerate(rows):
        out[k, : len(row)] = row
    return out


VELOCITY_VERLET = SplittingMethod(2, np.array([0.0, 1.0, 0.0]), np.array([0.5, 0.5]))
BLANES_MOAN_4 = SplittingMethod.from_first_half(
    4, [0.0792036964311957, 0.353172906049774, -0.0420650803577195], [0.209515106613362, -0.143851773179818]
)
BLANES_MOAN_6 = SplittingMethod.from_first_half(
    6,
    [0.0502627644003922, 0.413514300428344, 0.0450798897943977, -0.188054853819569, 0.541960678450780],
    [0.148816447901042, -0.132385865767784, 0.067307604692185, 0.432666402578175],
)
RUNGE_KUTTA_4 = ExplicitTableau(
    4, _lower_triangular([], [0.5], [0.0, 0.5], [0.0, 0.0, 1.0], [1 / 6, 1 / 3, 1 / 3, 1 / 6]), np.zeros((0, 5))
)
TSITOURAS_5 = ExplicitTableau(
    5,
    _lower_triangular(
        [],
        [0.161],
        [-0.008480655492356989, 0.335480655492357],
        [2.8971530571054935, -6.359448489975075, 4.3622954328695815],
        [5.325864828439257, -11.748883564062828, 7.4955393428898365, -0.09249506636175525],
        [5.86145544294642, -12.92096931784711, 8.159367898576159, -0.071584973281401, -0.028269050394068383],
        [
            *(0.09646076681806523, 0.01, 0.4798896504144996),
            *(1.379008574103742, -3.290069515436081, 2.324710524099774),
        ],
    ),
    np.array(
        [
            [
                *(-0.00178001105222577714, -0.0008164344596567469, 0.007880878010261995),
                *(-0.1447110071732629, 0.5823571654525552, -0.45808210592918697, 1.0 / 66.0),
            ]
        ]
    ),
    5.0,
)


DORMAND_PRINCE_8 = ExplicitTableau(
    8,
    _lower_triangular(
        [],
        [0.05260015195876773],
        [0.0197250569845379, 0.0591751709536137],
        [0.02958758547680685, 0.0, 0.08876275643042054],
        [0.2413651341592667, 0.0, -0.8845494793282861, 0.924834003261792],
        [0.037037037037037035, 0.0, 0.0, 0.17082860872947386, 0.12546768756682242],
        [0.037109375, 0.0, 0.0, 0.17025221101954405, 0.06021653898045596, -0.017578125],
        [
            *(0.03709200011850479, 0.0, 0.0, 0.17038392571223998, 0.10726203044637328, -0.015319437748624402),
            0.008273789163814023,
        ],
        [
            *(0.6241109587160757, 0.0, 0.0, -3.3608926294469414, -0.868219346841726, 27.59209969944671),
            *(20.154067550477894, -43.48988418106996),
        ],
        [
            *(0.47766253643826434, 0.0, 0.0, -2.4881146199716677, -0.590290826836843, 21.230051448181193),
            *(15.279233632882423, -33.28821096898486, -0.020331201708508627),
        ],
        [
            *(-0.9371424300859873, 0.0, 0.0, 5.186372428844064, 1.0914373489967295, -8.149787010746927),
            *(-18.52006565999696, 22.739487099350505, 2.4936055526796523, -3.0467644718982196),
        ],
        [
            *(2.273310147516538, 0.0, 0.0, -10.53449546673725, -2.0008720582248625, -17.9589318631188),
            *(27.94888452941996, -2.8589982771350235, -8.87285693353063, 12.360567175794303, 0.6433927460157636),
        ],
        [
            *(0.054293734116568765, 0.0, 0.0, 0.0, 0.0, 4.450312892752409, 1.8915178993145003),
            *(-5.801203960010585, 0.3111643669578199, -0.1521609496625161, 0.20136540080403034, 0.04471061572777259),
        ],
    ),
    np.array(
        [
            [
                *(0.01312004499419488, 0.0, 0.0, 0.0, 0.0, -1.2251564463762044, -0.4957589496572502),
                *(1.6643771824549864, -0.35032884874997366, 0.3341791187130175, 0.08192320648511571),
                *(-0.022355307863886294, 0.0),
            ],
            [
                *(-0.18980075407240762, 0.0, 0.0, 0.0, 0.0, 4.450312892752409, 1.8915178993145003),
                *(-5.801203960010585, -0.4226823213237919, -0.1521609496625161, 0.20136540080403034),
                *(0.02265179219836082, 0.0),
            ],
        ]
    ),
    8.0,
)
