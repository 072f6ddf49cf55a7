"""A plugin on an axis of a study: what its numbers depend on."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

from vibench.study import registry


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
    """A plugin with its options as canonical JSON, and the version of its code and data (`registry.code_and_data`)."""

    kind: str
    name: str
    options: str
    code: str

    @classmethod
    def from_entry(cls, kind: str, entry: Named) -> Plugin:
        """Plugin of an entry of an axis."""
        options = registry.canonical_options(kind, entry.name, entry.options)
        return cls(kind, entry.name, options, "").as_installed()

    def as_installed(self) -> Plugin:
        """The same with the version of the code that is installed, and of the files its options name, now.

        Raises
        ------
        RequestError
            If it is not installed, or one of its files cannot be read.
        """
        return replace(self, code=registry.code_and_data(self.kind, self.name, json.loads(self.options)))

    def create(self) -> Any:
        """A new instance."""
        return registry.create(self.kind, self.name, json.loads(self.options))

    @property
    def check(self) -> str:
        """The command that checks the plugin with these options."""
        word = next(word for word, kind in registry.WORDS.items() if kind == self.kind)
        options = (f"{k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in json.loads(self.options).items())
        return shlex.join(["vibench", "check", f"{word}:{self.name}", *(f"--option={text}" for text in options)])
