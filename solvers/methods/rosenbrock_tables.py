"""Coefficients of Rosenbrock methods for y' = F(y), in the form without products with the Jacobian J.

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

Row = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Rosenbrock:
    """Coefficients of a Rosenbrock method.

    Attributes:
        order, embedded: orders of the method and of the embedded method.
        gamma: diagonal coefficient.
        a, c: rows of 0 to s - 1 entries.
        m, e: weights of the solution and of the error estimate (s,).
    """

    order: int
    embedded: int
    gamma: float
    a: tuple[Row, ...]
    c: tuple[Row, ...]
    m: Row
    e: Row


_TWO = 1.0 - 0.5**0.5
ROS2 = Rosenbrock(
    2,
    1,
    _TWO,
    ((), (1.0 / _TWO,)),
    ((), (-2.0 / _TWO,)),
    (1.5 / _TWO, 0.5 / _TWO),
    (0.5 / _TWO, 0.5 / _TWO),
)

_M3 = (2.0, 0.5773502691896258, 0.4226497308103742)
ROS3P = Rosenbrock(
    3,
    2,
    0.5 + 3.0**0.5 / 6.0,
    ((), (1.267949192431123,), (1.267949192431123, 0.0)),
    ((), (-1.607695154586736,), (-3.464101615137755, -1.732050807568877)),
    _M3,
    (_M3[0] - 2.113248654051871, _M3[1] - 1.0, _M3[2] - 0.4226497308103742),
)

_LAST = (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.687886036105895)
RODAS = Rosenbrock(
    4,
    3,
    0.25,
    (
        (),
        (1.544,),
        (0.9466785280815826, 0.2557011698983284),
        (3.314825187068521, 2.896124015972201, 0.9986419139977817),
        _LAST,
        (*_LAST, 1.0),
    ),
    (
        (),
        (-5.6688,),
        (-2.430093356833875, -0.2063599157091915),
        (-0.1073529058151375, -9.594562251023355, -20.47028614809616),
        (7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160),
        (8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054),
    ),
    (*_LAST, 1.0, 1.0),
    (0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
)
