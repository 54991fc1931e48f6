"""The skill registry of a robot at a site is narrower; an adapter for the robot's own registry is compatible."""

import pytest

from dualbrain.adaptation.adapters.card import read_adapter_card
from dualbrain.adaptation.adapters.compatibility import require_compatible
from dualbrain.adaptation.adapters.packaged import packaged_folder
from dualbrain.contracts.registry import is_narrower
from dualbrain.errors import ConfigurationError
from dualbrain.grounding.vocabulary import load_skill_registry, skill_registry_at_site
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.runtime import run_resources
from dualbrain.runtime.session import Session
from tests.stories.story_session import make_clocks, run_config

CAPS = "[robot]\ntool_speed = 0.25\n[limits]\nvelocity = 0.5\n"


@pytest.fixture
def site(tmp_path):
    path = tmp_path / "lab.toml"
    path.write_text(CAPS)
    return path


@pytest.mark.parametrize("robot", ["panda", "ur5e", "base", "mobile_panda"])
def test_the_registry_at_a_site_is_narrower_than_that_of_the_robot(site, robot):
    own, at_site = load_skill_registry(robot), skill_registry_at_site(robot, site)
    assert at_site.hash != own.hash
    assert is_narrower(at_site, own)
    assert not is_narrower(own, at_site)


def test_an_adapter_is_compatible_only_with_a_narrower_registry(site):
    own, at_site = load_skill_registry("panda").hash, skill_registry_at_site("panda", site).hash
    card = read_adapter_card(packaged_folder("base-135m"))
    require_compatible(card, "panda", at_site, {at_site: own})
    for wrong in ({}, {own: at_site}, {"00000000": own}, {at_site: "00000000"}):
        with pytest.raises(ConfigurationError, match="was trained for the vocabulary"):
            require_compatible(card, "panda", at_site, wrong)


@pytest.mark.parametrize("caps", [CAPS, ""])
def test_a_session_passes_the_narrowed_registry_to_the_planner(site, tmp_path, monkeypatch, caps):
    opened = {}

    def open_planner(name, cache, **options):
        opened.update(options)
        return ScriptedPlanner([])

    site.write_text(caps)
    monkeypatch.setattr(run_resources, "open_planner", open_planner)
    with Session(run_config(tmp_path, site=site), make_clocks(), {}):
        pass
    at_site = skill_registry_at_site("panda", site).hash
    assert opened["registry"] == at_site
    assert opened["narrowed_registries"] == {at_site: load_skill_registry("panda").hash}
