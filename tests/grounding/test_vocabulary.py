"""At a site a robot has its own vocabulary, narrowed; an adapter that was taught the robot's own fits there, too."""

import pytest

from dualbrain.adaptation.adapters.card import read_adapter_card
from dualbrain.adaptation.adapters.compatibility import require_compatible
from dualbrain.adaptation.adapters.packaged import packaged_folder
from dualbrain.contracts.registry import is_narrower
from dualbrain.errors import ConfigurationError
from dualbrain.grounding.vocabulary import load_skill_registry, skill_registry_at_site
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.runtime import session
from dualbrain.runtime.session import Session
from tests.stories.story_session import make_clocks, run_config

CAPS = "[robot]\ntool_speed = 0.25\n[limits]\nvelocity = 0.5\n"


@pytest.fixture
def site(tmp_path):
    path = tmp_path / "lab.toml"
    path.write_text(CAPS)
    return path


@pytest.mark.parametrize("robot", ["panda", "ur5e", "base", "mobile_panda"])
def test_whatever_a_site_caps_its_vocabulary_only_narrows_the_robots_own(site, robot):
    own, there = load_skill_registry(robot), skill_registry_at_site(robot, site)
    assert there.hash != own.hash
    assert is_narrower(there, own)
    assert not is_narrower(own, there)


def test_an_adapter_fits_a_site_that_narrows_and_nothing_else(site):
    own, there = load_skill_registry("panda").hash, skill_registry_at_site("panda", site).hash
    card = read_adapter_card(packaged_folder("base-135m"))
    require_compatible(card, "panda", there, {there: own})
    for wrong in ({}, {own: there}, {"00000000": own}, {there: "00000000"}):
        with pytest.raises(ConfigurationError, match="vocabulary of adapter"):
            require_compatible(card, "panda", there, wrong)


@pytest.mark.parametrize("caps", [CAPS, ""])
def test_a_session_says_which_vocabulary_its_site_narrows(site, tmp_path, monkeypatch, caps):
    opened = {}

    def open_planner(name, cache, **told):
        opened.update(told)
        return ScriptedPlanner([])

    site.write_text(caps)
    monkeypatch.setattr(session, "open_planner", open_planner)
    with Session(run_config(tmp_path, site=site), make_clocks(), {}):
        pass
    here = skill_registry_at_site("panda", site).hash
    assert opened["registry"] == here
    assert opened["narrowed"] == {here: load_skill_registry("panda").hash}
