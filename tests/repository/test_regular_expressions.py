"""No regular expression of the package takes more than linear time on a text that repeats its own parts."""

import ast
import gc
import importlib
import itertools
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dualbrain.grounding.instruction.goals.goal_reading import MAX_CHARACTERS
from dualbrain.grounding.instruction.review import MAX_INSTRUCTION
from tests.support.growth import growth_of_cost

SOURCE = Path(__file__).parents[2] / "src"
FUNCTIONS = ("compile", "search", "match", "fullmatch", "split", "findall", "finditer", "sub", "subn")
MAX_GROWTH, MAX_PARTS = 2.2, 10
PROBE_SIZE, PROBE_S = 1 << 13, 4e-3
"""A text of this size that takes less time [s] is taken in linear time: quadratic time is about 0.1 s."""

# Where the pattern depends on values of the running program: why its cost is bounded.
COMPUTED = {
    "dualbrain.grounding.instruction.goals.clause_forms": "prepositions without repetition",
    "dualbrain.grounding.instruction.goals.noun_phrases": "nouns of a scene, against at most 400 characters",
    "dualbrain.grounding.instruction.goals.manner": "names of a contract, against at most 400 characters",
    "dualbrain.grounding.instruction.recalled_steps": "names of objects in a scene, against an instruction",
    "dualbrain.grounding.instruction.names": "names of places in a scene, bounded alternatives without repetition",
    "dualbrain.adaptation.conversion.peft_lora": "keys of LAYER_NAME_PATTERN, against names of modules",
    "dualbrain.knowledge.library": "patterns of two formats, against documents of bounded size",
    "dualbrain.simulation.tasks.placement": "names of objects in a scene, against an instruction of bounded length",
    "dualbrain.simulation.tasks.multi_goal": "names of objects in a scene, against an instruction of bounded length",
}


BOUNDED = {
    "dualbrain.grounding.instruction.goals": MAX_CHARACTERS,
    "dualbrain.grounding.instruction.clauses": MAX_INSTRUCTION,
    "dualbrain.grounding.instruction.words": MAX_INSTRUCTION,
    "dualbrain.grounding.instruction.stated_values": MAX_CHARACTERS,
}
"""Packages and modules whose patterns get at most this number of characters, and the largest time of one call [s]."""
BOUNDED_S = 0.01


def bound_of(where: str) -> int | None:
    """The largest number of characters that the patterns of a module get, None without a bound."""
    return next((bound for name, bound in BOUNDED.items() if where.startswith(name)), None)


def calls() -> Iterator[tuple[str, int, ast.expr, str, ast.Call]]:
    """Module, line and pattern of each call of `re` in the package."""
    for path in sorted(SOURCE.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if "import re\n" not in text:
            continue
        module = ".".join(path.relative_to(SOURCE).with_suffix("").parts)
        for node in ast.walk(ast.parse(text)):
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Attribute)
                and isinstance(node.func.value, ast.Name)
                and node.func.value.id == "re"
                and node.func.attr in FUNCTIONS
            ):
                yield module, node.lineno, node.args[0], node.func.attr, node


def evaluate(module: str, expression: ast.expr) -> object:
    return eval(compile(ast.Expression(expression), module, "eval"), vars(importlib.import_module(module)))


def patterns() -> Iterator[tuple[str, str, str | bytes, int, tuple[str, ...]]]:
    for module, line, argument, function, call in calls():
        try:
            pattern = evaluate(module, argument)
            given = [one.value for one in call.keywords if one.arg == "flags"]
            given += call.args[1:2] if function == "compile" else []
            flags = int(evaluate(module, given[0])) if given else 0
        except NameError:
            assert module in COMPUTED, f"{module}:{line}: state in COMPUTED why the cost of this pattern is bounded"
            continue
        if isinstance(pattern, (str, bytes)):
            functions = sorted(used_methods(module, call)) or ["fullmatch", "search"]
            yield module, f"{module}:{line}", pattern, flags, tuple(functions if function == "compile" else [function])


def parts(tree: object) -> Iterator[str]:
    """Characters and words that a pattern accepts, from its syntax tree."""
    word = ""
    for operator, argument in tree:
        if str(operator) == "LITERAL":
            word += chr(argument)
            yield chr(argument)
            continue
        yield word
        word = ""
        yield from parts_of_one(str(operator), argument)
    yield word


def parts_of_one(name: str, argument: object) -> Iterator[str]:
    match name:
        case "IN":
            yield from in_set(argument)
        case "ANY":
            yield from ("x", " ")
        case "NOT_LITERAL":
            yield "x" if argument != ord("x") else "y"
        case "MAX_REPEAT" | "MIN_REPEAT":
            yield from parts(argument[2])
        case "SUBPATTERN":
            yield from parts(argument[3])
        case "BRANCH":
            for branch in argument[1]:
                yield from parts(branch)
        case "ASSERT" | "ASSERT_NOT":
            yield from parts(argument[1])


def in_set(items: list) -> Iterator[str]:
    if str(items[0][0]) == "NEGATE":
        yield from ("x", " ", "\n")
        return
    for operator, argument in items:
        match str(operator):
            case "LITERAL":
                yield chr(argument)
            case "RANGE":
                yield chr(argument[0])
            case "CATEGORY":
                yield {"SPACE": " ", "DIGIT": "0", "WORD": "a"}.get(str(argument).rpartition("_")[2], "x")


def attacks(pattern: str | bytes, flags: int) -> Iterator[tuple[str, str, str]]:
    """Beginnings, repeated units and ends of texts that a backtracking engine may try in many ways."""
    text = pattern if isinstance(pattern, str) else pattern.decode("latin-1")
    found = sorted({part for part in parts(re._parser.parse(text, flags)) if part}, key=lambda part: (len(part), part))
    found = list(dict.fromkeys([*found[: MAX_PARTS // 2], *found[-MAX_PARTS // 2 :], " ", "\n"]))
    units = [*found, *(a + b for a, b in itertools.permutations([*found[:3], *found[-5:-2]], 2))]
    yield from itertools.product(["", *found[-6:]], units, ["", "\x00\n"])


def used_methods(module: str, call: ast.Call) -> set[str]:
    """The methods of a compiled pattern that its module calls, by the name that it is assigned to."""
    path = SOURCE.joinpath(*module.split(".")).with_suffix(".py")
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = {
        target.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign) and ast.dump(node.value) == ast.dump(call)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    return {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in names
    } & set(FUNCTIONS)


@pytest.fixture(autouse=True)
def without_garbage_collection():
    """Many match objects start a collection of all objects, which takes longer than the expressions."""
    gc.disable()
    yield
    gc.enable()


def takes_less(duration: float, work: Callable[[int], None], size: int) -> bool:
    """Whether one of five calls takes less processor time than `duration` [s]; other processes make a call slower."""
    for _ in range(5):
        start = time.process_time()
        work(size)
        if time.process_time() - start < duration:
            return True
    return False


@pytest.mark.parametrize(
    ("where", "pattern", "flags", "functions"), [pytest.param(*rest, id=rest[0]) for _, *rest in patterns()]
)
def test_an_expression_takes_linear_time(
    where: str, pattern: str | bytes, flags: int, functions: tuple[str, ...]
) -> None:
    compiled = re.compile(pattern, flags)
    for (begin, unit, end), function in itertools.product(attacks(pattern, flags), functions):

        def work(size: int, begin=begin, unit=unit, end=end, function=function) -> None:
            text = begin + unit * (size // len(unit)) + end
            data = text if isinstance(pattern, str) else text.encode("latin-1", "replace")
            if function == "finditer":
                list(compiled.finditer(data))
            elif function in ("sub", "subn"):
                compiled.sub(data[:0], data)
            else:
                getattr(compiled, function)(data)

        if bound := bound_of(where):
            assert takes_less(BOUNDED_S, work, bound), f"{where}: {pattern!r} on {begin!r} + {unit!r} + {end!r}"
            continue
        if takes_less(PROBE_S, work, PROBE_SIZE):
            continue
        growth = growth_of_cost(work, 1 << 9, max_size=1 << 15)
        assert growth < MAX_GROWTH, f"{where}: {pattern!r} on {begin!r} + {unit!r} repeated + {end!r}: {growth:.1f}"
