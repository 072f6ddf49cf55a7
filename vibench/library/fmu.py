"""An exported model as an FMU: an archive of FMI 2.0 with its description, its C source and its program."""

from __future__ import annotations

import hashlib
import io
import sys
import zipfile
from collections.abc import Mapping
from typing import Any
from xml.etree.ElementTree import Element, SubElement, tostring

from vibench.arrays import Array
from vibench.errors import RequestError, foreign
from vibench.files import scratch
from vibench.offline import c_source
from vibench.offline.compiled import compiled


def fmu(source: str, arrays: Mapping[str, Array], about: Mapping[str, Any], stem: str, corrected: int) -> bytes:
    """The FMU for co-simulation of a model with this C source, whose certificate is asked for `corrected` answers.

    Raises a `RequestError` if there are no linear outputs, or two variables would have the same name.
    """
    if "outputs_x" not in arrays:
        raise RequestError("the problem has no linear outputs, which an FMU needs; a C source, NAME.c, needs none")
    name, start = c_source.identifier(stem), 0.5 * (arrays["lower"] + arrays["upper"])
    box, outputs = about["parameters"], about["outputs"]["linear"]
    numbers = (map(repr, each.tolist()) for each in (start, arrays["lower"], arrays["upper"]))
    inputs = zip(box["names"], box["units"], *numbers, strict=True)
    variables = [dict(zip(("name", "unit", "start", "min", "max"), each, strict=True)) for each in inputs]
    variables += outputs
    if certified := "certificate_rows" in arrays:
        variables += [{**one, "name": f"bound:{one['name']}"} for one in outputs]
        variables += [{"name": f"bound_{of}"} for of in ("u_energy", "lambda_natural", "u_relative")]
    elif corrected:
        raise RequestError("the cell corrects its answers at high-fidelity cost, which no FMU can: it has no bounds")
    names = [one["name"] for one in variables] + ["status"]
    for twice in (one for one in names if names.count(one) > 1):
        raise RequestError(f"two variables of the FMU would have the name '{twice}'; rename a parameter or an output")
    # The same model has the same identifier, and is the same file.
    guid = hashlib.sha256(f"{source}{variables}{corrected}".encode()).hexdigest()[:32]
    source += c_source.filled("fmu.c", {
        "name": name, "guid": guid, "start": ", ".join(map(repr, start.tolist())),
        "rows": len(arrays["certificate_generators"]) if certified else 1,
        "loads": arrays["certificate_outputs_shift"].shape[1] if certified else 1,
        "certified": int(certified), "corrected": corrected, "output_count": len(outputs), "values": len(variables),
    })  # fmt: skip
    # The program may run on another processor than this one.
    with foreign("the C compiler cannot be used"), scratch() as folder:
        binary = compiled(source, folder, native=False).read_bytes()
    platform, end = ("darwin64", "dylib") if sys.platform == "darwin" else ("linux64", "so")
    contents = {
        "modelDescription.xml": _description(variables, about, name, stem, guid),
        f"sources/{name}.c": source.encode(), f"binaries/{platform}/{name}.{end}": binary,
    }  # fmt: skip
    archived = io.BytesIO()
    with zipfile.ZipFile(archived, "w") as archive:
        for path, content in contents.items():
            # Without the time of today; files of an archive may be unpacked with the rights that it names.
            entry = zipfile.ZipInfo(path)
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content, zipfile.ZIP_DEFLATED)
    return archived.getvalue()


def _description(variables: list[dict[str, str]], about: Mapping[str, Any], name: str, stem: str, guid: str) -> bytes:
    """The XML description of the variables, and of the status behind them."""
    root = Element(
        "fmiModelDescription", fmiVersion="2.0", modelName=stem, guid=guid, variableNamingConvention="flat",
        description=f"Bounds of errors: {about['no_bounds'] or about['certificate']}.",
        license=about["source"]["licence"], generationTool=about["exported_by"],
    )  # fmt: skip
    able = {"canHandleVariableCommunicationStepSize": "true", "canNotUseMemoryManagementFunctions": "true"}
    slave = SubElement(root, "CoSimulation", able, modelIdentifier=name)
    SubElement(SubElement(slave, "SourceFiles"), "File", name=f"{name}.c")
    units, listed, structure = (
        SubElement(root, tag) for tag in ("UnitDefinitions", "ModelVariables", "ModelStructure")
    )
    for unit in sorted({one["unit"] for one in variables if "unit" in one}):
        SubElement(units, "Unit", name=unit)
    unknowns = [SubElement(structure, tag) for tag in ("Outputs", "InitialUnknowns")]
    for number, one in enumerate([*variables, {"name": "status"}]):
        # The status is a number of the C program, not of the model.
        kind, variability = ("Real", "continuous") if number < len(variables) else ("Integer", "discrete")
        about_it = {"name": one["name"], "valueReference": f"{number}", "variability": variability}
        causality = "input" if "start" in one else "output"
        variable = SubElement(listed, "ScalarVariable", about_it, causality=causality)
        SubElement(variable, kind, {key: one[key] for key in one if key != "name"})
        for element in unknowns * (causality == "output"):
            SubElement(element, "Unknown", index=str(number + 1))
    return bytes(tostring(root, encoding="utf-8", xml_declaration=True))
