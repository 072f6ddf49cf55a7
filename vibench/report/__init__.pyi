"""The public names of `vibench.report`: drawing of figures."""

from .figures.data import ProblemTables as ProblemTables
from .figures.data import problem_tables as problem_tables
from .figures.solutions import draw_field as draw_field
from .figures.solutions import draw_multiplier as draw_multiplier
from .figures.solutions import name_axes as name_axes
from .figures.style import HIGH_FIDELITY_LOOK as HIGH_FIDELITY_LOOK
from .figures.style import CaptionedFigure as CaptionedFigure
from .figures.style import Layout as Layout
from .figures.style import Look as Look
from .figures.style import Looks as Looks
from .figures.style import Series as Series
from .figures.style import Sheet as Sheet
from .figures.style import plot as plot
from .figures.style import save as save
from .figures.style import scatter as scatter
from .figures.style import styled as styled
