"""The learned estimate of clauses: its arithmetic, its quotes, and its weight beside the rules."""

import numpy as np
import pytest
import torch

from dualbrain.core.paths import cache_folder
from dualbrain.grounding.instruction.clauses import clause_classifier
from dualbrain.grounding.instruction.clauses.clause_classifier import KINDS, ClauseClassifier, ClauseEstimate
from dualbrain.grounding.instruction.review import Refusal, review_instruction
from dualbrain.memory.embedding.text_encoder import MiniLmEncoder
from dualbrain.robots.loader import load_robot
from dualbrain.skills.registry import skill_registry
from tests.grounding.instruction.test_clauses import BASE_SLOTS, PLACES, REGISTRIES, SLOTS, packaged_sentences
from tools.clause_classifier.training import ENCODED, Layer, weights_of

PANDA = skill_registry(load_robot("panda"))


class RandomEncoder:
    id = "random"

    def __init__(self, rng):
        self.vectors = rng.normal(size=(9, ENCODED)).astype(np.float32)

    def encode_tokens(self, text):
        return self.vectors, tuple((2 * k, 2 * k + 1) for k in range(len(self.vectors)))


class FixedEstimate:
    def __init__(self, score):
        self.score, self.asked = score, 0

    def estimate(self, text):
        self.asked += 1
        return ClauseEstimate(self.score, "motion", "these words")


@pytest.fixture(scope="module")
def packaged():
    return ClauseClassifier.packaged(MiniLmEncoder.from_cache(cache_folder()))


def test_the_estimate_is_that_of_the_trained_layer():
    torch.manual_seed(3)
    layer, encoder = Layer().eval(), RandomEncoder(np.random.default_rng(3))
    with torch.no_grad():
        layer.token.weight *= 30.0  # so that the marks of some tokens only are above the threshold
        layer.token.bias[:] = clause_classifier.QUOTE_MARK
    weights = {name: value.astype(np.float32) for name, value in weights_of(layer).items()}
    layer.load_state_dict({name: torch.tensor(weights[own]) for name, own in named(layer).items()})
    with torch.no_grad():
        score, kind, marks = layer(torch.tensor(encoder.vectors)[None], torch.ones(1, 9, dtype=torch.bool))
    found = ClauseClassifier(encoder, weights).estimate("a b c d e f g h i")
    assert found.score == pytest.approx(float(score[0]), abs=1e-4)
    assert found.kind == KINDS[int(kind[0].argmax())]
    best = int(marks[0].argmax())
    above = (marks[0] > clause_classifier.QUOTE_MARK).tolist()
    first = max((k + 1 for k in range(best) if not above[k]), default=0)
    last = min((k for k in range(best, 9) if not above[k]), default=9)
    assert found.quote == " ".join("abcdefghi"[first:last])
    assert 0 < last - first < 9


def named(layer):
    """The names of the weights of the classifier, by those of the layer."""
    return dict(zip(layer.state_dict(), weights_of(layer), strict=True))


@pytest.mark.parametrize(
    ("text", "score", "declined"),
    [
        ("put the red cube in the bowl when the bell rings", 0.0, "when the bell rings"),
        ("put the red cube in the bowl when the bell rings", -0.9, "when the bell rings"),
        ("put the red cube in the bowl when the bell rings", -1.1, ""),
        ("put the red cube in the bowl", 0.9, ""),
        ("put the red cube in the bowl", 1.1, "these words"),
        ("place the red cube to the left of the bowl and the tin", 9.0, "to the left of the bowl"),
    ],
)
def test_the_one_that_is_sure_decides(text, score, declined):
    answer = review_instruction(text, PANDA, ["blue_bowl"], ["red_cube"], classifier=FixedEstimate(score))
    assert (answer.quote if isinstance(answer, Refusal) else "") == declined


def test_a_clause_that_the_scene_shows_remains():
    scene = (["blue_bowl", "table_left"], ["red_cube", "white_tin", "brown_box"])
    text = "put the cube onto the tin"
    assert isinstance(review_instruction(text, PANDA, *scene), Refusal)
    assert isinstance(review_instruction(text, PANDA, *scene, classifier=FixedEstimate(-9.0)), Refusal)


@pytest.mark.parametrize(
    ("text", "robot", "places", "objects"),
    [
        ("put both tins in the bowl", "panda", ["blue_bowl"], ["white_tin", "red_tin", "blue_tin"]),
        ("put all but the tins in the bowl", "panda", ["blue_bowl"], ["white_tin", "red_tin", "red_cube"]),
        ("drive to the charger and wait five seconds", "base", ["charger"], []),
        ("wait 500 seconds then put the red cube in the bowl", "panda", ["blue_bowl"], ["red_cube"]),
    ],
)
def test_a_clause_that_depends_on_robot_or_scene_remains(text, robot, places, objects):
    scene = (REGISTRIES[robot], places, objects)
    assert isinstance(review_instruction(text, *scene), Refusal)
    assert isinstance(review_instruction(text, *scene, classifier=FixedEstimate(-9.0)), Refusal)


def test_a_clause_beyond_the_words_that_the_encoder_reads_remains(packaged):
    text = f"put the red cube in the bowl. {'. ' * 260}when the bell rings"
    assert packaged.estimate(text).score >= 0.0
    assert isinstance(review_instruction(text, PANDA, ["blue_bowl"], ["red_cube"], classifier=packaged), Refusal)


def test_a_planner_of_other_languages_is_asked_without_the_classifier():
    sure = FixedEstimate(9.0)
    scene = (["blue_bowl"], ["red_cube"])
    assert review_instruction("put the red cube in the bowl", PANDA, *scene, languages=("*",), classifier=sure) is None
    assert sure.asked == 0


def test_hidden_characters_do_not_keep_a_text_from_the_classifier():
    read = []

    class Recorder(FixedEstimate):
        def estimate(self, text):
            read.append(text)
            return super().estimate(text)

    hidden = "\ud800put the red cube\x00 in\u200b the bowl\u00ad"
    answer = review_instruction(hidden, PANDA, ["blue_bowl"], ["red_cube"], classifier=Recorder(9.0))
    assert isinstance(answer, Refusal)
    assert read == ["put the red cube in the bowl"]


def test_a_robot_with_other_skills_is_judged_by_the_rules_alone(monkeypatch):
    monkeypatch.setattr(clause_classifier, "PACKAGED_SKILLS", frozenset({"grasp"}))
    sure = FixedEstimate(9.0)
    assert review_instruction("put the red cube in the bowl", PANDA, ["blue_bowl"], classifier=sure) is None
    assert sure.asked == 0


def test_stop_commands_do_not_wait_for_the_classifier():
    sure = FixedEstimate(9.0)
    assert not isinstance(review_instruction("stop", PANDA, classifier=sure), Refusal)
    assert sure.asked == 0


def test_no_packaged_sentence_is_declined_because_of_the_classifier(packaged):
    texts = {
        (robot, sentence.format(**(BASE_SLOTS if robot == "base" else SLOTS)))
        for robot, kind, sentence in packaged_sentences()
    }
    refused = []
    for robot, text in sorted(texts):
        answer = review_instruction(text, REGISTRIES[robot], PLACES, classifier=packaged)
        if isinstance(answer, Refusal):
            refused.append((robot, text, answer.quote))
    assert refused == []


@pytest.mark.parametrize(
    ("text", "kind", "word"),
    [
        ("the tin goes to whoever asks first", "handing over", "whoever asks"),
        ("the tin wants a spot beside its friend the cube", "relative place", "beside"),
        ("tin in, tin out, tin in, the whole morning long", "time", "morning"),
        ("have the tin twirl in the air before it lands in the bowl", "motion", "twirl"),
    ],
)
def test_clauses_in_words_without_a_rule_are_found_and_named(packaged, text, kind, word):
    scene = (["blue_bowl"], ["white_tin", "red_cube"])
    assert review_instruction(text, PANDA, *scene) is None
    answer = review_instruction(text, PANDA, *scene, classifier=packaged)
    assert isinstance(answer, Refusal)
    assert word in answer.quote
    assert kind in answer.reason


def test_long_and_odd_texts_have_an_estimate(packaged):
    for text in ("", "   ", "\ud800 tin", "\u00e9\u4e2d" * 300, "tin " * 400, "...", "\ufeff"):
        assert np.isfinite(packaged.estimate(text).score)


def test_another_encoder_leaves_the_rules_alone():
    assert ClauseClassifier.packaged(RandomEncoder(np.random.default_rng(0))) is None
