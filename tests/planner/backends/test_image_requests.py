"""The camera image in requests: exact bytes in the form of each server, refusals as values, and the limits."""

import base64
import hashlib
import json
from io import BytesIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from dualbrain.errors import ConfigurationError
from dualbrain.evaluation.planners.answer_cache import request_hash
from dualbrain.planner import protocol
from dualbrain.planner.backends.image_message import announce_image
from dualbrain.planner.backends.openai_server import DIALECTS, ServerConfig, ServerPlanner
from dualbrain.planner.camera_image import MAX_IMAGE_BYTES, CameraImage, encode_camera_image, read_camera_image
from dualbrain.planner.introspection import require_image_input, takes_images
from dualbrain.planner.prompt import image_note
from dualbrain.planner.prompt.full_prompt import conditional_text_hash, render, template_hash
from dualbrain.planner.scripted import ScriptedPlanner
from tests.planner.backends.fake_chat_server import chat_completion, respond_with, serve
from tests.planner.sample_requests import plan_request

FOLDER = Path(__file__).parent / "image_requests"
IMAGE = CameraImage((FOLDER / "scene.png").read_bytes())
CONTRACT = '{"id":"c-0007"}'
SCHEMA_FIELDS = ("response_format", "structured_outputs", "format", "grammar")


def ask(dialect: str, body: bytes = b"", status: int = 200, image: CameraImage | None = IMAGE) -> tuple[Any, Any]:
    """The proposal, and path and body of the request that the server got."""
    own = json.dumps({"message": {"content": CONTRACT}, "done": True, "done_reason": "stop"}).encode()
    answer = body or (own if dialect == "ollama" else chat_completion(CONTRACT))
    with serve(respond_with(answer, status)) as server:
        planner = ServerPlanner(ServerConfig(url=server.url, timeout_s=5.0, dialect=dialect, model="m"))
        return planner.propose(plan_request(image=image)), server.requests[0]


def parts(body: dict[str, Any]) -> tuple[str, bytes]:
    """Text and image bytes of the last message, in either form."""
    last = body["messages"][-1]
    if "images" in last:
        return last["content"], base64.b64decode(last["images"][0], validate=True)
    text, image = last["content"]
    head, _, data = image["image_url"]["url"].partition(",")
    assert head == "data:image/png;base64"
    return text["text"], base64.b64decode(data, validate=True)


@pytest.mark.parametrize("dialect", ["openai", "vllm", "llama.cpp", "ollama"])
def test_each_server_gets_the_request_of_its_golden_file(dialect: str) -> None:
    _, (path, body) = ask(dialect)
    text, _ = parts(body)
    for name in SCHEMA_FIELDS:
        if name in body:
            body[name] = "(schema)"
    body["messages"] = body["messages"][-1:]
    sent = json.loads(json.dumps({"path": path, "body": body}).replace(json.dumps(text), '"(text)"'))
    assert sent == json.loads((FOLDER / f"{dialect}.json").read_text())


@pytest.mark.parametrize("dialect", DIALECTS)
def test_the_server_gets_the_bytes_of_the_image_and_an_unchanged_prompt(dialect: str) -> None:
    proposal, (_, body) = ask(dialect)
    text, data = parts(body)
    assert data == IMAGE.data
    assert (proposal.text, proposal.finish_reason) == (CONTRACT, protocol.STOP)
    assert text == f"{image_note.IMAGE_NOTE}\n{render(plan_request())[-1]['content']}"
    assert body["messages"][:-1] == render(plan_request())[:-1]


def test_the_text_about_the_image_is_in_the_hash_of_conditional_text_only(monkeypatch: pytest.MonkeyPatch) -> None:
    before, template = conditional_text_hash(), template_hash()
    monkeypatch.setattr(image_note, "IMAGE_NOTE", "other words")
    assert announce_image(render(plan_request()))[-1]["content"].startswith("other words\n")
    assert (conditional_text_hash() == before, template_hash()) == (False, template)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_request_without_an_image_is_unchanged(dialect: str) -> None:
    _, (_, body) = ask(dialect, image=None)
    assert body["messages"] == render(plan_request())


@pytest.mark.parametrize("status", [400, 500])
def test_a_server_that_takes_no_image_becomes_a_sentence_with_a_fix(status: int) -> None:
    error = b'{"error":{"message":"image input is not supported by this server"}}'
    proposal, _ = ask("llama.cpp", error, status)
    assert not protocol.has_answer(proposal)
    words = protocol.describe_failure(proposal.finish_reason)
    assert words.startswith(f"the planner did not answer: status {status}. The model of this server may take no image")
    assert "--mmproj" in words
    assert "image input is not supported" in words
    assert "image" not in ask("llama.cpp", b'{"error":"no"}', status, image=None)[0].finish_reason


def test_an_image_changes_the_hash_of_a_request_and_its_absence_does_not() -> None:
    without, fields = plan_request(), msgspec.to_builtins(plan_request())
    assert fields.pop("image") is None
    earlier = hashlib.sha256(json.dumps(["p", fields], sort_keys=True).encode()).hexdigest()
    assert request_hash("p", without) == earlier[:32]
    assert request_hash("p", without) != request_hash("p", plan_request(image=IMAGE))


def test_a_planner_without_images_is_refused_by_name() -> None:
    with pytest.raises(ConfigurationError, match=r"scripted takes no image. .*vision-language"):
        require_image_input(ScriptedPlanner(()))
    planner = ServerPlanner(ServerConfig(url="http://localhost/v1"))
    require_image_input(planner)
    assert takes_images(planner)


def encoded(width: int, height: int, form: str = "PNG", *, noise: bool = False) -> bytes:
    pixels = np.random.default_rng(0).integers(0, 256 if noise else 1, (height, width, 3), np.uint8)
    data = BytesIO()
    Image.fromarray(pixels).save(data, form)
    return data.getvalue()


def huge() -> bytes:
    """A file of few bytes with 100 million pixels."""
    data = BytesIO()
    Image.new("1", (10_000, 10_000)).save(data, "PNG")
    return data.getvalue()


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (encoded(321, 240), "321x240"),
        (encoded(320, 241, "JPEG"), "320x241"),
        (huge(), "damaged"),
        (encoded(200, 200, noise=True), "larger than 40 kB"),
        (encoded(20, 20, "GIF"), "not a PNG or JPEG"),
        (encoded(20, 20)[:-20], "damaged"),
        (b"", "not a PNG or JPEG"),
        (b"<svg/>", "not a PNG or JPEG"),
    ],
    ids=["wide", "high", "huge", "large file", "GIF", "truncated", "empty", "SVG"],
)
def test_an_image_beyond_the_limits_is_refused_with_a_fix(data: bytes, problem: str, tmp_path: Path) -> None:
    (tmp_path / "image.png").write_bytes(data)
    with pytest.raises(ConfigurationError, match=problem) as raised:
        read_camera_image(tmp_path / "image.png")
    assert "at most 320x240 pixels and 40 kB" in str(raised.value)


@pytest.mark.parametrize("form", ["PNG", "JPEG"])
def test_an_image_within_the_limits_is_kept_byte_for_byte(form: str, tmp_path: Path) -> None:
    data = encoded(320, 240, form)
    (tmp_path / "image").write_bytes(data)
    image = read_camera_image(tmp_path / "image")
    assert (image.data, image.media_type) == (data, f"image/{form.lower()}")


def test_a_camera_image_is_lossless_unless_it_is_too_large() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (240, 320, 3), np.uint8)
    assert encode_camera_image(np.zeros((240, 320, 3), np.uint8)).media_type == "image/png"
    smooth = np.repeat(np.repeat(pixels[::8, ::8], 8, 0), 8, 1)
    smooth[::2] //= 2
    image = encode_camera_image(smooth)
    assert np.array_equal(np.asarray(Image.open(BytesIO(image.data))), smooth)
    gradient = (np.indices((240, 320)).sum(0)[..., None] * [3, 5, 7] + pixels % 12).astype(np.uint8)
    assert encode_camera_image(gradient).media_type == "image/jpeg"


@settings(max_examples=60, deadline=None)
@given(position=st.integers(0, len(IMAGE.data) - 1), value=st.integers(0, 255))
def test_a_damaged_image_is_refused_or_still_an_image(position: int, value: int) -> None:
    data = bytearray(IMAGE.data)
    data[position] = value
    try:
        image = CameraImage(bytes(data))
    except ConfigurationError:
        return
    assert len(image.data) <= MAX_IMAGE_BYTES
