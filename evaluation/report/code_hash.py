"""The hash of the code that a step of the report depends on.

The hash of a Python file includes all modules of this package that the file imports. Comments,
docstrings and layout of Python files do not affect it.
"""

import ast
import hashlib
from collections.abc import Iterable, Iterator
from pathlib import Path

from kouxing.evaluation.source_tree import ROOT

_PACKAGES = {"kouxing": "", "kouxing_client": "clients/python/kouxing_client"}
_SOURCES = {".py", ".js", ".mjs", ".ts", ".html", ".json", ".toml", ".tsv", ".npz", ".txt"}
_INSTALLED = {"node_modules", ".venv"}


def code_hash(patterns: Iterable[str], root: Path = ROOT) -> str:
    """Return a hash of files and folders, and of the modules that their Python files import."""
    digest = hashlib.sha256()
    for name, content in sorted(_read_code(patterns, root).items()):
        digest.update(name.encode() + content)
    return digest.hexdigest()[:16]


def _read_code(patterns: Iterable[str], root: Path) -> dict[str, bytes]:
    contents: dict[str, bytes] = {}
    waiting = [
        file for pattern in patterns for path in root.glob(pattern) for file in _source_files(path)
    ]
    while waiting:
        file = waiting.pop()
        name = str(file.relative_to(root))
        if name in contents or _INSTALLED & {*file.relative_to(root).parts}:
            continue
        contents[name] = file.read_bytes()
        if file.suffix == ".py":
            tree = ast.parse(contents[name])
            waiting += _imported_files(tree, root)
            contents[name] = _without_docstrings(tree).encode()
    return contents


def _source_files(path: Path) -> Iterator[Path]:
    for file in path.rglob("*") if path.is_dir() else (path,):
        if file.suffix in _SOURCES and file.is_file():
            yield file


def _imported_files(tree: ast.Module, root: Path) -> Iterator[Path]:
    modules: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            modules += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    for module in modules:
        package, _, inner = module.partition(".")
        if package in _PACKAGES and inner:
            path = root / _PACKAGES[package] / inner.replace(".", "/")
            files = (path.with_suffix(".py"), path / "__init__.py")
            yield from (file for file in files if file.is_file())


def _without_docstrings(tree: ast.Module) -> str:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                node.body = node.body[1:] or [ast.Pass()]
    return ast.unparse(tree)
