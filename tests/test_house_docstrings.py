"""Documented names against signatures, read from the source; examples are run."""

from __future__ import annotations

import ast
import doctest
import importlib
import importlib.util
from pathlib import Path

import pytest
from numpydoc.docscrape import NumpyDocString

REPOSITORY = Path(__file__).resolve().parent.parent
FOLDERS = ("", "bake", "operators", "preview", "tree")
MODULE_LINES = 10
# Blender calls these by name, with arguments that it documents itself.
BLENDER_METHODS = {"poll", "invoke", "execute", "modal", "cancel", "draw", "draw_header", "check", "update"}
Function = ast.FunctionDef | ast.AsyncFunctionDef


def modules() -> list[Path]:
    """Every module of the package."""
    return [path for folder in FOLDERS for path in sorted((REPOSITORY / folder).glob("*.py"))]


def name_of(path: Path) -> str:
    """Path from the repository's root."""
    return path.relative_to(REPOSITORY).as_posix()


def parameters(function: Function, bound: bool) -> list[str]:
    """Names as numpydoc writes them: with stars, without self."""
    arguments = function.args
    names = [argument.arg for argument in (*arguments.posonlyargs, *arguments.args)][1 if bound else 0 :]
    names += [f"*{arguments.vararg.arg}"] if arguments.vararg else []
    names += [argument.arg for argument in arguments.kwonlyargs]
    return names + ([f"**{arguments.kwarg.arg}"] if arguments.kwarg else [])


def documented(docstring: str, section: str) -> list[str]:
    """Names in one section; one entry may hold several."""
    entries = NumpyDocString(docstring)[section]
    return [name.strip() for entry in entries for name in entry.name.split(",")]


def decorators(node: Function | ast.ClassDef) -> set[str]:
    """Last parts of the names of a definition's decorators."""
    called = [decorator.func if isinstance(decorator, ast.Call) else decorator for decorator in node.decorator_list]
    return {decorator.attr if isinstance(decorator, ast.Attribute) else decorator.id for decorator in called}


def check_function(node: Function, where: str, bound: bool) -> list[str]:
    """What is wrong with one function's docstring."""
    docstring = ast.get_docstring(node)
    if not docstring:
        return [f"{where}: no docstring"]
    names = parameters(node, bound and "staticmethod" not in decorators(node))
    told = documented(docstring, "Parameters")
    return [] if told == names else [f"{where}: documents the parameters {told}, takes {names}"]


def check_class(node: ast.ClassDef, where: str) -> list[str]:
    """What is wrong with a class's docstring, its fields and its public methods."""
    docstring = ast.get_docstring(node)
    if not docstring:
        return [f"{where}: no docstring"]
    found = []
    fields = [
        item.target.id for item in node.body if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)
    ]
    start = next((item for item in node.body if isinstance(item, Function) and item.name == "__init__"), None)
    takes = parameters(start, bound=True) if start else fields
    told = documented(docstring, "Parameters")
    if (told or start) and told != takes:
        found.append(f"{where}: documents the parameters {told}, takes {takes}")
    unknown = set(documented(docstring, "Attributes")) - set(fields) - properties(node) if fields else set()
    found += [f"{where}: documents the attribute {name}, which it has not" for name in sorted(unknown)]
    for item in node.body:
        if isinstance(item, Function) and not item.name.startswith("_") and not is_blenders(node, item):
            found += check_function(item, f"{where}.{item.name}", bound=True)
    return found


def properties(node: ast.ClassDef) -> set[str]:
    """Names of a class's properties."""
    return {item.name for item in node.body if isinstance(item, Function) and "property" in decorators(item)}


def is_blenders(node: ast.ClassDef, method: Function) -> bool:
    """Whether Blender's protocol prescribes a method."""
    return method.name in BLENDER_METHODS and (node.name.startswith("GIVOLUMES_") or node.name.startswith("_"))


def defects(source: str, file: str) -> list[str]:
    """What is wrong with the docstrings of one module."""
    tree = ast.parse(source)
    docstring = ast.get_docstring(tree)
    found = [] if docstring else [f"{file}: no docstring"]
    if docstring and len(docstring.splitlines()) > MODULE_LINES and "```" not in docstring and "    " not in docstring:
        found.append(f"{file}: a module's docstring has at most {MODULE_LINES} lines")
    for node in tree.body:
        if isinstance(node, Function | ast.ClassDef) and not node.name.startswith("_"):
            where = f"{file}:{node.lineno} {node.name}"
            found += check_class(node, where) if isinstance(node, ast.ClassDef) else check_function(node, where, False)
    return found


@pytest.mark.parametrize("path", modules(), ids=name_of)
def test_every_public_name_documents_the_parameters_that_it_takes(path):
    assert defects(path.read_text(), name_of(path)) == []


@pytest.mark.parametrize("path", modules(), ids=name_of)
def test_the_examples_of_a_module_give_what_they_say(path):
    if ">>>" not in path.read_text():
        return
    dotted = ".".join(["gi_volumes", *path.relative_to(REPOSITORY).with_suffix("").parts])
    outcome = doctest.testmod(importlib.import_module(dotted), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert (outcome.failed, outcome.attempted > 0) == (0, True)


SECTION = '"""Do.\n\n    Parameters\n    ----------\n    {} : int\n        A number.\n    """'


@pytest.mark.parametrize(
    "body",
    [
        "def f(a):\n    pass",
        "def f(a):\n    " + SECTION.format("b"),
        "def f(a, b):\n    " + SECTION.format("a"),
        "def f():\n    " + SECTION.format("a"),
        "class C:\n    pass",
        "class C:\n    '''C.'''\n    def m(self, a):\n        '''M.'''",
        "class C:\n    '''C.'''\n    def __init__(self, a):\n        pass",
    ],
)
def test_a_planted_docstring_defect_is_found(body):
    assert len(defects(f'"""Module."""\n{body}\n', "planted.py")) == 1


def test_a_correct_docstring_passes():
    body = "def f(a):\n    " + SECTION.format("a") + "\n\nclass C:\n    '''C.'''\n    x: int = 0\n"
    assert defects(f'"""Module."""\n{body}\n', "planted.py") == []
