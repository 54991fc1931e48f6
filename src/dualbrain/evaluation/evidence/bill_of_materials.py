"""Software bill of materials (CycloneDX 1.6): the installed Python packages and the model files of the manifest."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import msgspec

from dualbrain.core.weights import MANIFEST, WeightFile
from dualbrain.errors import ConfigurationError, MissingDependencyError

TIMEOUT_S = 120.0
"""Time limit for reading the installed packages [s]."""


def write_bill_of_materials() -> bytes:
    """The bill of materials of this environment as JSON.

    The tool cyclonedx-py lists the packages with version and licence. Every model file of the manifest is a component
    with licence, SHA-256 and the packages that contain it.

    Raises:
        MissingDependencyError: cyclonedx-bom is not installed.
        ConfigurationError: The tool failed or took too long.
    """
    command = [sys.executable, "-m", "cyclonedx_py", "environment", "--of", "JSON", "--sv", "1.6", sys.prefix]
    try:
        done = subprocess.run(command, capture_output=True, timeout=TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise ConfigurationError.stating(
            f"The list of installed packages took more than {TIMEOUT_S:g} s.", fix="Try again on an idle machine."
        ) from error
    if done.returncode != 0:
        reason = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or ["no reason given"]
        if "No module named" in reason[0]:
            raise MissingDependencyError("The tool cyclonedx-py", fix="pip install 'dualbrain[evidence]'")
        raise ConfigurationError.stating(
            f"The installed packages could not be listed: {reason[0]}.", fix="Check the environment with `pip check`."
        )
    bill = msgspec.json.decode(done.stdout, type=dict[str, Any])
    for component in bill.get("components", []):
        remove_local_references(component)
    bill.setdefault("components", []).extend(model_component(file) for file in MANIFEST.values())
    return msgspec.json.format(msgspec.json.encode(bill), indent=1) + b"\n"


def remove_local_references(component: dict[str, Any]) -> None:
    """Remove the references to files of this machine from a component."""
    references = component.get("externalReferences", [])
    kept = [one for one in references if not str(one.get("url", "")).startswith("file:")]
    if references:
        component["externalReferences"] = kept


def model_component(file: WeightFile) -> dict[str, Any]:
    """The component of a model file: name, SHA-256, licence, size, and the packages that its parts are in."""
    sources = [{"type": "distribution", "url": package_url(part.requirement)} for part in file.parts]
    hub = [{"type": "distribution", "url": file.hub_url}] if file.hub_url else []
    return {
        "type": "machine-learning-model",
        "bom-ref": f"model:{file.name}",
        "name": file.name,
        "hashes": [{"alg": "SHA-256", "content": file.sha256}],
        "licenses": [{"license": {"id": file.licence}}],
        "externalReferences": sources + hub,
        "properties": [
            {"name": "dualbrain:filename", "value": file.filename},
            {"name": "dualbrain:size", "value": str(file.size)},
        ],
    }


def package_url(requirement: str) -> str:
    """The package URL of a pinned requirement of PyPI, `name==version`."""
    name, _, version = requirement.partition("==")
    return f"pkg:pypi/{name}@{version}"
