"""The public names of `vibench.qp`: verification of quadratic programs."""

from .verification import kkt_residuals as kkt_residuals
from .verification import verify as verify
