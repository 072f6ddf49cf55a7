"""The public names of `vibench.reduction`: building blocks of cones and enrichments."""

from .cone_subtraction import subtract_cone_component as subtract_cone_component
from .cones import REPRODUCED as REPRODUCED
from .cones import TIE as TIE
from .cones import GrowingCone as GrowingCone
from .cones import LazyDistances as LazyDistances
from .cones import LazyMaximum as LazyMaximum
from .cones import hull_distances as hull_distances
from .cones import refuse_negative as refuse_negative
from .cubatures import Cubature as Cubature
from .cubatures import cubature as cubature
from .supremizers import constraint_classes as constraint_classes
from .supremizers import projected_supremizers as projected_supremizers
from .supremizers import supremizer_coordinates as supremizer_coordinates
