"""SBOM of a release in CycloneDX: the packages of an environment, and the model files that dualbrain downloads."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from dualbrain.core.weights import MANIFEST, WeightFile
from dualbrain.evaluation.evidence.bill_of_materials import model_component
from tools.release.environments import BUNDLED, ROOT, Environment, run_program

SPECIFICATION = "1.6"
"""Version of CycloneDX."""
PARTS = ("components", "dependencies")
"""Parts of an SBOM with one entry for each package."""
VALIDATION = """
import sys
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator
sys.exit(str(JsonStrictValidator(SchemaVersion.V1_6).validate_str(open(sys.argv[1]).read()) or "") or 0)
"""


def write_sbom(path: Path, environment: Environment, tools: Environment) -> dict[str, Any]:
    """Write the SBOM of what `environment` contains to `path`, check it against its schema, and return it."""
    command = [
        tools.program("cyclonedx-py"),
        "environment",
        "--sv",
        SPECIFICATION,
        "--of",
        "JSON",
        "--mc-type",
        "library",
    ]
    printed = run_program(
        [*command, "--output-reproducible", "--pyproject", ROOT / "pyproject.toml", environment.python]
    )
    found = add_model_files(without_installers(json.loads(printed)), MANIFEST.values())
    path.write_text(json.dumps(found, indent=1) + "\n", "utf-8")
    run_program([tools.python, "-c", VALIDATION, path])
    return found


def without_installers(sbom: dict[str, Any]) -> dict[str, Any]:
    """A copy of `sbom` without the packages that every new environment has, which are not part of a release."""
    removed = {one["bom-ref"] for one in sbom["components"] if one["name"] in BUNDLED}
    kept = {
        part: [one for one in sbom.get(part, ()) if one.get("bom-ref", one.get("ref")) not in removed] for part in PARTS
    }
    return {**sbom, **kept}


def add_model_files(sbom: dict[str, Any], files: Iterable[WeightFile]) -> dict[str, Any]:
    """A copy of `sbom` with one component for each model file."""
    return {**sbom, "components": [*sbom.get("components", ()), *map(model_component, files)]}
