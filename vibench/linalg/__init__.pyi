"""The public names of `vibench.linalg`: dense linear algebra for nearly rank-deficient matrices."""

from .inner_product import RANK_RTOL as RANK_RTOL
from .inner_product import orthonormal_range as orthonormal_range
from .inner_product import project_out as project_out
from .inner_product import singular_values as singular_values
from .inner_product import svd as svd

EPS: float
UNIT_ROUND_OFF: float
