"""The mixed formulation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from vibench import Formulation, FormulationModel, ProgramModel

if TYPE_CHECKING:
    from vibench import OfflinePhase


class Mixed(Formulation):
    """The quadratic program of V_N, its enrichment and the reduced cone, solved by a QP solver."""

    takes_start = True
    has_program = True
    has_certificate = True
    is_default = True

    def model(self, offline: OfflinePhase, built: Mapping[str, Any]) -> FormulationModel:  # noqa: ARG002
        """The Galerkin projection on these spaces, assembled in full or in reduced form."""
        return ProgramModel(offline.assembled)
