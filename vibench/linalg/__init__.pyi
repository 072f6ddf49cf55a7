"""The public names of `vibench.linalg`: dense linear algebra for nearly rank-deficient matrices."""

from .dense import RANK_RTOL as RANK_RTOL
from .dense import orthonormal_range as orthonormal_range
from .dense import project_out as project_out
from .dense import singular_values as singular_values
from .dense import svd as svd
