"""JSON schema of study files, for editors that complete and check keys: `fracsim schema`.

Names, descriptions, units, defaults and examples are those of `fracsim.study.values.key`. What depends on several keys
is checked by the program alone.
"""

from __future__ import annotations

import math
from typing import Any

from . import Study

DIALECT = "https://json-schema.org/draft/2020-12/schema"
# keys that [material] like supplies, by table
_SUPPLIED = {
    "MaterialSettings": ["young", "poisson", "density"],
    "FractureSettings": ["strength"],
    "PlasticitySettings": ["yield_stress"],
}


def study_schema() -> dict[str, Any]:
    """JSON schema (draft 2020-12) of a study file."""
    schema = Study.model_json_schema()
    for name, table in schema["$defs"].items():
        title = table.get("title", name)
        if "required" in table:
            table["required"] = [key for key in table["required"] if key not in _SUPPLIED.get(title, [])]
        if title == "FractureSettings":
            table["properties"]["energy"]["anyOf"].append({"const": True})  # that of [material] like
        if title == "MaterialSettings":
            table["anyOf"] = [{"required": ["like"]}, {"required": _SUPPLIED[title]}]
            # tables inside [material] are regions of the mesh
            table["additionalProperties"] = table["properties"].pop("regions")["additionalProperties"]
    return {"$schema": DIALECT} | _without_infinity(schema)


def _without_infinity(part: Any) -> Any:
    """Part of a schema without infinite defaults and examples, which JSON cannot hold."""
    if isinstance(part, list):
        return [_without_infinity(item) for item in part if not _is_infinite(item)]
    if isinstance(part, dict):
        return {key: _without_infinity(item) for key, item in part.items() if not _is_infinite(item)}
    return part


def _is_infinite(value: Any) -> bool:
    return isinstance(value, float) and math.isinf(value)
