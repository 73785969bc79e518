"""The objective of a step: value, gradient, Hessian, positive semidefinite projection."""
