"""What `vibench help` says of keys of study files and of columns of the results."""

from __future__ import annotations

from collections.abc import Collection

from vibench.errors import unknown_name
from vibench.plugins.options import Key, keys, places
from vibench.results.ranking import ADDED
from vibench.results.schema import STORED
from vibench.study.spec import Study


def meanings(topic: str, commands: Collection[str]) -> list[str]:
    """A line for every key of a study file, and for every column, of this name or heading.

    Raises
    ------
    RequestError
        If nothing is called so, with what was probably meant; `commands` are names, too.
    """
    fields = list(keys(Study.model_json_schema()))
    described = {**STORED, "best": ADDED}
    columns = [(table, name, of) for table, own in described.items() for name, of in own.items()]
    tables: dict[str, list[str]] = {}  # those in which a column means the same, by what is said of it
    for table, name, of in columns:
        if topic in (name, of.heading, of.heading.partition(" [")[0]):  # also without its unit
            tables.setdefault(f"{name}{f' [{of.unit}]' * bool(of.unit)}, in {{}}: {of.meaning}", []).append(table)
    lines = [_of_key(field) for field in fields if field.name == topic]
    lines += [line.replace("{}", ", ".join(names), 1) for line, names in tables.items()]
    if not lines:
        headings = [of.heading for *_, of in columns if of.heading]
        known = {*commands, *(field.name for field in fields), *(name for _, name, _ in columns), *headings}
        raise unknown_name("command, key of study files or column", topic, known)
    return lines


def _of_key(key: Key) -> str:
    holders = places(Study.model_json_schema(), key.table) if key.table else []
    where = f"in {', '.join(holders)} of a study file" if holders else "in a study file"
    default = "required" if key.required else f"default {key.default}" * bool(key.default)
    about = ", ".join(filter(None, (key.expected.replace("`", ""), default)))
    return f"{key.name}, {where} ({about}): {key.meaning}"
