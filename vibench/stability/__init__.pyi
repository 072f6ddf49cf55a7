"""The public names of `vibench.stability`: inf-sup constants."""

from .infsup import beta_span as beta_span
from .infsup import cone_basis as cone_basis
from .infsup import inf_sup_full as inf_sup_full
from .infsup import inf_sup_on as inf_sup_on
