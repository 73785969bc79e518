"""The interface of integrators that yield the stages of a step one after the other.

A stage x minimises energies(x) + c/(2 dt^2) |x - target|_M^2 - tr(x' f), like the step of implicit Euler, with the same
c for all stages. So Q is factorised once, and every minimiser can be used. At the minimum M c/dt^2 (x - target) is the
force, so

    acceleration = c/dt^2 (x - target),     velocity = velocity_rate (x - velocity_origin)

and no further evaluation of the force is needed.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import NamedTuple

from springbench.solvers.model.step_problem import Positions


class Motion(NamedTuple):
    """The motion at one time: positions (n, 3) [m] and velocity (n, 3) [m/s].

    Example:
        >>> import numpy as np
        >>> springbench.Motion(positions=np.zeros((1, 3)), velocity=np.ones((1, 3))).velocity.tolist()
        [[1.0, 1.0, 1.0]]
    """

    positions: Positions
    velocity: Positions


class Stage(NamedTuple):
    """A stage of a step.

    Attributes:
        stage_fraction: time of x as a fraction of the step, 1 at its end.
        inertial_target, velocity_origin: (n, 3) [m]; the caller may modify them.
        predicted_acceleration: acceleration (n, 3) [m/s^2] at x predicted from the previous motion; None for none.

    Example:
        >>> import numpy as np
        >>> p, v = np.zeros((1, 3)), np.ones((1, 3))
        >>> method = springbench.RungeKutta(order=1, a=((1.0,),))  # implicit Euler
        >>> stage = next(method.iterate_stages(springbench.Motion(p, v), None, 0.5))
        >>> stage.stage_fraction, stage.inertial_target.tolist()
        (1.0, [[0.5, 0.5, 0.5]])
    """

    stage_fraction: float
    inertial_target: Positions
    velocity_origin: Positions
    predicted_acceleration: Positions | None


class StageSolution(NamedTuple):
    """The solution of a stage: positions [m], velocity [m/s] and acceleration [m/s^2], each (n, 3).

    Example:
        >>> import numpy as np
        >>> p, v = np.zeros((1, 3)), np.ones((1, 3))
        >>> method = springbench.RungeKutta(order=1, a=((1.0,),))  # implicit Euler
        >>> stages = method.iterate_stages(springbench.Motion(p, v), None, 0.5)
        >>> x = next(stages).inertial_target  # no force acts
        >>> try:
        ...     stages.send(springbench.StageSolution(x, v, 0.0 * v))
        ... except StopIteration as end:
        ...     end.value.motion.positions.tolist()
        [[0.5, 0.5, 0.5]]
    """

    positions: Positions
    velocity: Positions
    acceleration: Positions


class StepEnd(NamedTuple):
    """The result of a step.

    Attributes:
        motion: motion at the end of the step.
        acceleration: (n, 3) [m/s^2] at the end of the step.
        error: error estimate of the motion by an embedded method of another order; None without one.

    Example:
        >>> import numpy as np
        >>> motion = springbench.Motion(np.zeros((1, 3)), np.ones((1, 3)))
        >>> springbench.StepEnd(motion, acceleration=np.zeros((1, 3))).motion.velocity.tolist()
        [[1.0, 1.0, 1.0]]
    """

    motion: Motion
    acceleration: Positions
    error: Motion | None = None


StageGenerator = Generator[Stage, StageSolution, StepEnd]
"""A generator of the stages of a step; it is sent the solution of each stage before it yields the next."""
