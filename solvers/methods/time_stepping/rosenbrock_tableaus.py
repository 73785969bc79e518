"""Coefficients of Rosenbrock methods for y' = F(y), without products with the Jacobian J.

    (1/(gamma h) - J) u_i = F(y + sum_(j<i) a_ij u_j) + sum_(j<i) c_ij/h u_j,    y' = y + sum_i m_i u_i

(Hairer and Wanner, Solving Ordinary Differential Equations II, section IV.7, 7.25). The error estimate is
h sum_i e_i u_i, the difference from the embedded method.

    ROS2     Verwer, Spee, Blom and Hundsdorfer 1999, "A second-order Rosenbrock method applied to photochemical
             dispersion problems", with the smaller of the two gammas that are L-stable; order 2 for any matrix J
    ROS3P    Lang and Verwer 2001, "ROS3P: an accurate third-order Rosenbrock solver designed for parabolic problems":
             A-stable, damps the highest frequencies by a factor of 0.73 per step
    RODAS    Hairer and Wanner, section IV.7 of the same book and the code RODAS: L-stable and stiffly accurate
"""

from __future__ import annotations

from dataclasses import dataclass

TableauRow = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class RosenbrockTableau:
    """Coefficients of a Rosenbrock method.

    Attributes:
        order, embedded_order: orders of the method and of the embedded method.
        gamma: diagonal coefficient.
        a, c: rows of 0 to s - 1 entries.
        m, e: weights of the solution and of the error estimate (s,).
    """

    order: int
    embedded_order: int
    gamma: float
    a: tuple[TableauRow, ...]
    c: tuple[TableauRow, ...]
    m: TableauRow
    e: TableauRow


_ROS2_GAMMA = 1.0 - 0.5**0.5
ROS2_TABLEAU = RosenbrockTableau(
    2,
    1,
    _ROS2_GAMMA,
    ((), (1.0 / _ROS2_GAMMA,)),
    ((), (-2.0 / _ROS2_GAMMA,)),
    (1.5 / _ROS2_GAMMA, 0.5 / _ROS2_GAMMA),
    (0.5 / _ROS2_GAMMA, 0.5 / _ROS2_GAMMA),
)

_ROS3P_WEIGHTS = (2.0, 0.5773502691896258, 0.4226497308103742)
ROS3P_TABLEAU = RosenbrockTableau(
    3,
    2,
    0.5 + 3.0**0.5 / 6.0,
    ((), (1.267949192431123,), (1.267949192431123, 0.0)),
    ((), (-1.607695154586736,), (-3.464101615137755, -1.732050807568877)),
    _ROS3P_WEIGHTS,
    (_ROS3P_WEIGHTS[0] - 2.113248654051871, _ROS3P_WEIGHTS[1] - 1.0, _ROS3P_WEIGHTS[2] - 0.4226497308103742),
)

_RODAS_LAST_ROW = (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.687886036105895)
RODAS_TABLEAU = RosenbrockTableau(
    4,
    3,
    0.25,
    (
        (),
        (1.544,),
        (0.9466785280815826, 0.2557011698983284),
        (3.314825187068521, 2.896124015972201, 0.9986419139977817),
        _RODAS_LAST_ROW,
        (*_RODAS_LAST_ROW, 1.0),
    ),
    (
        (),
        (-5.6688,),
        (-2.430093356833875, -0.2063599157091915),
        (-0.1073529058151375, -9.594562251023355, -20.47028614809616),
        (7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160),
        (8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054),
    ),
    (*_RODAS_LAST_ROW, 1.0, 1.0),
    (0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
)
