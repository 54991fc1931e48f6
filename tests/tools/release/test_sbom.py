"""The SBOM lists every model file of the manifest with its digest, licence and source."""

import json
import re

from dualbrain.core.weights import MANIFEST
from dualbrain.evaluation.evidence.bill_of_materials import model_component
from tools.release.sbom import add_model_files, without_installers

PACKAGES = {"bomFormat": "CycloneDX", "components": [{"type": "library", "name": "numpy"}]}


def test_every_model_file_is_a_component_beside_the_packages():
    components = add_model_files(PACKAGES, MANIFEST.values())["components"]
    assert components[0] == PACKAGES["components"][0]
    models = {one["name"]: one for one in components if one["type"] == "machine-learning-model"}
    assert models.keys() == MANIFEST.keys()
    for name, file in MANIFEST.items():
        assert models[name]["hashes"] == [{"alg": "SHA-256", "content": file.sha256}]
        assert models[name]["licenses"] == [{"license": {"id": file.licence}}]
    assert len({one.get("bom-ref") for one in models.values()}) == len(MANIFEST)
    assert json.loads(json.dumps(components)) == components


def test_a_model_file_names_each_package_that_holds_a_part_of_it():
    file = MANIFEST["qwen2.5-coder-1.5b-instruct"]
    *packages, hub = (one["url"] for one in model_component(file)["externalReferences"])
    assert len(packages) == len(file.parts) == 22
    assert all(re.fullmatch(r"pkg:pypi/[a-z0-9-]+@[0-9.]+", url) for url in packages)
    assert hub == file.hub_url


def test_the_installer_is_not_part_of_a_release():
    parts = [{"bom-ref": f"{name}==1", "name": name} for name in ("numpy", "pip", "setuptools")]
    dependencies = [{"ref": f"{name}==1"} for name in ("numpy", "pip")]
    kept = without_installers({"components": parts, "dependencies": dependencies})
    assert kept == {"components": parts[:1], "dependencies": dependencies[:1]}
