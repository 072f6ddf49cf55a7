"""A plugin on an axis of a study: what its numbers depend on."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

from vibench.study import registry
from vibench.study.kinds import PluginKind
from vibench.study.registry import RegisteredPlugin


class Named(Protocol):
    """An entry of an axis, as far as a plugin depends on it."""

    @property
    def name(self) -> str:
        """Name under which the plugin is registered."""
        ...

    @property
    def options(self) -> Mapping[str, Any]:
        """Options that the entry gives."""
        ...


@dataclass(frozen=True)
class Plugin:
    """A plugin with its options as canonical JSON, and the version of its code and of the files that these name."""

    kind: PluginKind
    name: str
    options: str
    code: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "kind", PluginKind(self.kind))  # a text, where it is read from a results file

    def __str__(self) -> str:
        return str(self.registered)

    @classmethod
    def from_entry(cls, kind: PluginKind, entry: Named) -> Plugin:
        """Plugin of an entry of an axis."""
        options = registry.find(kind, entry.name).canonical_options(entry.options)
        return cls(kind, entry.name, options, "").as_installed()

    @property
    def registered(self) -> RegisteredPlugin:
        """What is registered under its name."""
        return registry.find(self.kind, self.name)

    def as_installed(self) -> Plugin:
        """The same with the version of the code that is installed, and of the files its options name, now.

        Raises
        ------
        RequestError
            If it is not installed, or one of its files cannot be read.
        """
        data = self.registered.data_digest(json.loads(self.options))
        return replace(self, code=f"{self.registered.code} data {data}" if data else self.registered.code)

    def create(self) -> Any:
        """A new instance."""
        return self.registered.create(json.loads(self.options))

    @property
    def check(self) -> str:
        """The command that checks the plugin with these options."""
        options = (f"{k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in json.loads(self.options).items())
        return shlex.join(
            ["vibench", "check", f"{self.kind.cli_name}:{self.name}", *(f"--option={text}" for text in options)]
        )
