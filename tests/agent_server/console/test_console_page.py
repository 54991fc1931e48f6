"""The console in a browser without WebGL: untrusted text, the gate's verdict while typing, stops, and the keyboard."""

import base64
import json
from io import BytesIO

import pytest
from PIL import Image

from tests.agent_server.console.console_server import TOKEN, serve_console
from tests.agent_server.console.test_console_requests import write_run
from tests.memory.memory_samples import NOW, REST_POSTURE, episode, open_ledger, open_memory
from tests.visualization.headless_browser import Browser

MARKUP = '<img src="x" onerror="document.title=1"><b>bold</b>'
READY = "return document.getElementById('skills').textContent && document.querySelector('#verdict b')?.textContent"
VERDICT = "return document.getElementById('verdict').innerText"
TYPE = """
const text = document.getElementById('text');
text.value = arguments[0] ?? text.value;
text.dispatchEvent(new Event('input'));
"""
TAB, ENTER = "\ue004", "\ue007"


@pytest.fixture(scope="module")
def console(tmp_path_factory):
    """A console whose every text contains markup."""
    with serve_console(tmp_path_factory.mktemp("console")) as running:
        running.robot.summary = f"{MARKUP}: object\n{running.robot.summary}"
        running.robot.feed.add(1.25, f"phase{MARKUP}", MARKUP)
        report = "<h1>The report</h1><script>parent.document.title = top.document.title = 'owned'</script>"
        write_run(running.runs, "r-1", report=report, instruction=MARKUP)
        with open_ledger(running.ledger.parent, running.ledger.name) as ledger:
            memory = open_memory(ledger)
            memory.store(episode("e-1", instruction=MARKUP, proposer=MARKUP), REST_POSTURE, now=NOW)
        yield running


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("profile"), (1280, 900), "--disable-3d-apis") as opened:
        yield opened


@pytest.fixture
def page(browser, console):
    """The page, ready, with a robot that has no stop."""
    console.robot.lost, console.robot.stops[:] = False, []
    console.robot.reset()
    browser.open("about:blank")
    browser.open(console.page)
    browser.wait_for(READY, 15)
    return browser


def write(browser, text):
    """Type a contract and wait for the verdict on it."""
    browser.execute_script("document.querySelector('#verdict b').textContent = ''")
    browser.execute_script(TYPE.replace("arguments[0]", json.dumps(text)))
    return browser.wait_for("return document.querySelector('#verdict b')?.textContent", 10)


def press(browser, key):
    """Press and release a key, as a keyboard does."""
    strokes = [{"type": kind, "value": key} for kind in ("keyDown", "keyUp")]
    browser.send("/actions", {"actions": [{"type": "key", "id": "keyboard", "actions": strokes}]})


def test_every_text_is_shown_as_text_and_nothing_is_loaded_from_elsewhere(page, console):
    page.execute_script("document.getElementById('tab-memory').click()")
    page.wait_for("return document.querySelector('#memory-table td')")
    page.execute_script("document.getElementById('tab-runs').click()")
    page.wait_for("return document.querySelector('#runs-table td')")
    page.wait_for("return document.querySelector('#events li')")
    shown, markup, address, sources, stored, webgl = page.execute_script("""return [
      ['scene', 'events', 'runs-table', 'memory-table'].map((id) => document.getElementById(id).textContent),
      document.querySelectorAll('img, main b b, td b').length, location.href + document.title,
      performance.getEntriesByType('resource').map((entry) => entry.name), history.length && document.referrer,
      document.createElement('canvas').getContext('webgl') !== null]""")
    assert [text.count(MARKUP) for text in shown] == [1, 2, 1, 2]
    assert (markup, address, stored, webgl) == (0, f"{console.url}/consoledualbrain console", "", False)
    assert all(name.startswith(console.url) and TOKEN not in name for name in sources)
    assert not [line for line in page.console_messages() if "favicon" not in line]


def test_the_verdict_follows_the_text_and_names_the_place(page, console):
    contract = json.loads(page.execute_script("return document.getElementById('text').value"))
    assert "accepts" in page.execute_script(VERDICT)
    contract["action_sequence"].append({"skill": "hold", "params": {"duration": 99.0}})
    text = json.dumps(contract, indent=1).replace("99.0", " 99.0")
    assert write(page, text) == "Rejected at the stage envelope."
    assert console.robot.checked[-1] == text.encode()
    assert "at most 20 s" in page.execute_script(VERDICT)
    selected = page.execute_script("""
      document.getElementById('place').click();
      const text = document.getElementById('text');
      return text.value.slice(text.selectionStart, text.selectionEnd)""")
    assert selected == "99.0"
    assert write(page, text + "}") == "Rejected at the stage syntax."
    assert write(page, text.replace(" 99.0", "2.5")) == "The gate accepts this contract."


PLACES = {
    ("", '{"a": 1}'): '{"a": 1}',
    ("/a", '{"b": {"a": 3}, "a": [1, "x"]}'): '[1, "x"]',
    ("/a/1", '{"b": [0, 9], "a": [1, "x,]"]}'): '"x,]"',
    ("/a~1b/~0c", '{"a/b": {"~c": null}}'): "null",
    ("/0/k", '[{"k":-1.5e3},{"k":2}]'): "-1.5e3",
    ("/missing", '{"a": 1}'): None,
    ("/a/b", '{"a": {"b": "\\"}"} garbage'): '"\\"}"',
    ("/a", '{"a": '): None,
    ("/a", ""): None,
}


def test_a_pointer_finds_its_place_in_any_text(page):
    found = page.execute_script(
        f"const cases = {json.dumps(list(PLACES))};"
        """
        return import('/console/static/pointer.js').then(({ findPlace }) => cases.map(([pointer, text]) => {
          const place = findPlace(text, pointer);
          return place && text.slice(...place);
        }))"""
    )
    assert dict(zip(PLACES, found, strict=True)) == PLACES


@pytest.mark.parametrize(("button", "emergency"), [("estop", True), ("stop", False)], ids=["estop", "stop"])
def test_a_stop_by_keyboard_reaches_the_robot_and_is_confirmed(page, console, button, emergency):
    page.execute_script(f"document.getElementById('{button}').focus()")
    press(page, ENTER)
    answer = page.wait_for(
        "const p = document.getElementById('stop-answer'); return p.className === 'good' && p.textContent"
    )
    assert [one for one, _ in console.robot.stops] == [emergency]
    assert "confirms" in answer
    state = "emergency stop" if emergency else "hold"
    page.wait_for(f"return document.getElementById('state').textContent === {state!r}", 5)


def test_a_stop_that_is_not_confirmed_names_the_alternatives(page, console):
    console.robot.lost = True
    page.execute_script("document.getElementById('estop').click()")
    answer = page.wait_for(
        "const p = document.getElementById('stop-answer'); return p.className === 'bad' && p.textContent"
    )
    assert "NOT CONFIRMED: the gatekeeper closed the connection" in answer
    assert "dualbrain operate estop" in answer


def test_every_control_is_reached_by_the_keyboard_with_a_visible_focus(page):
    assert write(page, "{}").startswith("Rejected")
    expected = page.execute_script("""
      document.activeElement.blur();
      const controls = document.querySelectorAll('button, input, textarea, [tabindex]');
      const usable = (one) => one.offsetParent && !one.disabled && one.tabIndex >= 0;
      return [...controls].filter(usable).map((one) => one.id)""")
    reached = {}
    for _ in range(len(expected)):
        press(page, TAB)
        name, outline = page.execute_script("""
          const one = document.activeElement, style = getComputedStyle(one);
          return [one.id, style.outlineStyle !== 'none' ? parseFloat(style.outlineWidth) : 0]""")
        reached[name] = outline
    assert list(reached) == expected
    assert min(reached.values()) >= 2
    assert expected[:2] == ["stop", "estop"]
    assert "tab-contract" in expected
    assert "tab-runs" not in expected  # by the arrow keys, as usual for tabs
    page.execute_script("document.getElementById('tab-contract').focus()")
    press(page, "\ue014")
    assert page.execute_script("return document.activeElement.id") == "tab-runs"
    assert page.execute_script("return document.getElementById('contract').hidden") is True


def test_a_report_is_shown_in_a_sandbox_and_the_stop_stays(page):
    page.execute_script("document.getElementById('tab-runs').click()")
    page.wait_for("return document.querySelector('#runs-table td button')")
    page.execute_script("document.querySelector('#runs-table td button').click()")
    page.wait_for("return document.getElementById('report-frame').src")
    page.enter_frame(0)
    assert page.wait_for("return document.querySelector('h1')?.textContent", 10) == "The report"
    origin = page.execute_script("return self.origin")
    page.leave_frame()
    assert origin == "null"
    assert page.execute_script("return document.title") == "dualbrain console"
    assert page.execute_script("return document.getElementById('estop').getBoundingClientRect().top >= 0")


def test_without_the_token_the_page_asks_for_it(browser, console):
    browser.open("about:blank")
    browser.open(f"{console.url}/console#token=wrong-token-of-these-tests")
    browser.wait_for("return !document.getElementById('access').hidden")
    assert browser.execute_script("return document.getElementById('main').hidden") is True
    browser.execute_script(f"""
      document.getElementById('token').value = '{TOKEN}';
      document.querySelector('#access button').click()""")
    browser.wait_for(READY, 15)
    assert browser.execute_script("return document.getElementById('access').hidden") is True


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_both_colour_schemes_have_readable_text(page, scheme):
    page.send(
        "/goog/cdp/execute",
        {
            "cmd": "Emulation.setEmulatedMedia",
            "params": {"features": [{"name": "prefers-color-scheme", "value": scheme}]},
        },
    )
    image = Image.open(BytesIO(base64.b64decode(page.screenshot()))).convert("L")
    background = sum(image.getpixel((x, 500)) for x in range(2, 18)) / 16
    assert (background > 200) == (scheme == "light")
    contrast = page.execute_script("""
      const luminance = (text) => text.match(/[0-9.]+/g).slice(0, 3).map((c) => c / 255)
        .map((c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4))
        .reduce((sum, c, k) => sum + c * [0.2126, 0.7152, 0.0722][k], 0);
      const ground = (one) => { for (; one; one = one.parentElement) { const c = getComputedStyle(one).backgroundColor;
        if (c !== 'rgba(0, 0, 0, 0)') return c; } };
      return Math.min(...[...document.querySelectorAll('header *, main *')].filter((one) => one.offsetParent
        && !one.disabled && [...one.childNodes].some((node) => node.nodeType === 3 && node.data.trim())).map((one) => {
          const [a, b] = [luminance(getComputedStyle(one).color), luminance(ground(one))].sort((x, y) => y - x);
          return (a + 0.05) / (b + 0.05); }))""")
    assert contrast >= 4.5  # WCAG 2, level AA


def test_a_server_that_ends_is_noticed(browser, tmp_path):
    with serve_console(tmp_path) as running:
        browser.open(running.page)
        browser.wait_for(READY, 15)
        browser.wait_for("return document.getElementById('state').textContent === 'ready'")
    browser.wait_for("return document.getElementById('state').textContent === 'no connection'", 10)
    browser.execute_script("document.getElementById('estop').click()")
    browser.wait_for("return document.getElementById('stop-answer').textContent.includes('NOT CONFIRMED')", 10)
