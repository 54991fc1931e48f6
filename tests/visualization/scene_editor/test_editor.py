"""The scene editor: who may use its page, what it saves, and dragging in a browser."""

import json
from http.client import HTTPConnection
from threading import Thread

import msgspec
import pytest

from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.visualization.scene_editor.edited_scene import OBJECT_KINDS, page_data, read_edited_scene
from dualbrain.visualization.scene_editor.server import MAX_REQUEST_BYTES, TOKEN_HEADER, SceneEditorServer
from tests.visualization.headless_browser import Browser

ORIGINAL = open_scene("tabletop:1")


@pytest.fixture
def editor(tmp_path):
    server = SceneEditorServer(ORIGINAL, tmp_path / "mine.json", 0, lambda: None)
    thread = Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield server
    server.shutdown()
    server.server_close()
    thread.join()


def as_sent(*extra, person=False, **moved):
    """The scene as the page sends it, with other values of named objects."""
    kept = ("name", "kind", "colour", "x", "y", "yaw", "source")
    objects = [{key: one[key] for key in kept} | moved.get(one["name"], {}) for one in page_data(ORIGINAL)["objects"]]
    return msgspec.json.encode({"objects": [*objects, *extra], "person": person})


def test_an_unchanged_scene_is_saved_as_it_was():
    spec, problems = read_edited_scene(as_sent(), ORIGINAL)
    assert problems == []
    assert spec == msgspec.structs.replace(ORIGINAL, family="edited")


def test_a_moved_object_and_every_kind_of_new_object_can_be_simulated(editor):
    places = [(0.2 + 0.1 * (k % 3), -0.55 + 0.12 * (k // 3)) for k in range(len(OBJECT_KINDS))]
    new = [
        {"name": f"new_{kind}", "kind": kind, "colour": "teal", "x": x, "y": y, "yaw": 0.0}
        for kind, (x, y) in zip(OBJECT_KINDS, places, strict=True)
        if kind != "bowl"
    ]
    problems, saved = editor.receive(as_sent(*new, person=True, red_cube={"x": 0.3, "y": 0.3, "yaw": 1.0}), save=True)
    assert (problems, saved) == ([], str(editor.path))
    spec = open_scene(str(editor.path))
    assert spec.mover is not None
    assert spec.find("red_cube").position[:2] == (0.3, 0.3)
    assert spec.find("new_can").position[2] == OBJECT_KINDS["can"][1].half_height


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\xff", "cannot be read"),
        (b'{"objects": [], "robot": "x"}', "cannot be read"),
        (as_sent(red_cube={"x": 9.0}), "cannot be read"),
        (as_sent(red_cube={"name": "blue_bowl"}), "every name once"),
        (as_sent(red_cube={"name": "no name"}), "not an identifier"),
        (as_sent(red_cube={"x": 1.5}), "beside the table"),
        (as_sent({"name": "a", "kind": "gun", "colour": "red", "x": 0.3, "y": 0.0, "yaw": 0.0}), "kind of object"),
    ],
    ids=["bytes", "field", "range", "repeated", "name", "beside", "kind"],
)
def test_a_scene_with_a_problem_is_not_saved(editor, content, words):
    problems, saved = editor.receive(content, save=True)
    assert words in " ".join(problems)
    assert saved == ""
    assert not editor.path.exists()


@pytest.mark.parametrize(
    ("path", "headers", "status"),
    [
        ("/save", {}, 403),
        ("/save", {TOKEN_HEADER: "guessed"}, 403),
        ("/save", {TOKEN_HEADER: None, "Host": "evil.example"}, 403),
        ("/delete", {TOKEN_HEADER: None}, 403),
        ("/save", {TOKEN_HEADER: None, "Content-Length": str(MAX_REQUEST_BYTES + 1)}, 413),
        ("/save", {TOKEN_HEADER: None, "Content-Length": "-1"}, 413),
        ("/check", {TOKEN_HEADER: None}, 200),
    ],
    ids=["no_token", "wrong_token", "host", "path", "size", "negative", "own"],
)
def test_only_the_page_itself_may_send_a_scene(editor, path, headers, status):
    """A token of None is replaced by that of the page."""
    values = {name: value or editor.token for name, value in headers.items()}
    connection = HTTPConnection("127.0.0.1", editor.server_port, timeout=10)
    connection.request("POST", path, as_sent(), values)
    assert connection.getresponse().status == status
    connection.close()
    assert not editor.path.exists()


def test_the_page_is_sent_to_its_own_host_only_and_names_are_data(editor):
    name = "</script><script>@TOKEN@"
    objects = (msgspec.structs.replace(ORIGINAL.objects[0], name=name), *ORIGINAL.objects[1:])
    editor.original = msgspec.structs.replace(ORIGINAL, objects=objects)
    page = editor.page()
    assert page.count("</script>") == 1
    assert page.count(editor.token) == 1
    assert json.dumps("\\u003c/script>\\u003cscript>@TOKEN@").replace("\\\\", "\\") in page
    connection = HTTPConnection("127.0.0.1", editor.server_port, timeout=10)
    connection.request("GET", "/", headers={"Host": "evil.example"})
    assert connection.getresponse().status == 404
    connection.close()


DRAG = """
const group = [...document.querySelectorAll('.object')].find((one) => one.textContent === 'red_cube');
if (!group) return null;
const table = document.getElementById('table'), box = group.querySelector('path').getBoundingClientRect();
table.setPointerCapture = () => {};
const send = (type, target, y) => target.dispatchEvent(new PointerEvent(type,
  {clientX: box.x + box.width / 2, clientY: y, pointerId: 1, bubbles: true}));
send('pointerdown', group.querySelector('path'), box.y);
send('pointermove', table, box.y + 100);
send('pointerup', table, box.y + 100);
document.getElementById('save').click();
return true;"""


def test_an_object_is_dragged_in_a_browser_and_saved(editor, tmp_path):
    with Browser(tmp_path / "profile", (1000, 700)) as browser:
        browser.open(editor.url)
        browser.wait_for(DRAG)
        browser.wait_for("return document.getElementById('saved').textContent.startsWith('Saved');")
        assert browser.console_messages() == []
    before, after = ORIGINAL.find("red_cube").position, open_scene(str(editor.path)).find("red_cube").position
    assert after[0] < before[0] - 0.05  # down the page is toward the robot
    assert after[1] == pytest.approx(before[1])
