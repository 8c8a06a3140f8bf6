"""No module of the package imports itself by way of others, imports inside functions included; the
order of the rooms is held by import-linter.
"""

import ast
import pathlib

import numpy as np
from scipy.sparse.csgraph import connected_components

import mjx_cl

ROOT = pathlib.Path(mjx_cl.__file__).parent


def imports(root: pathlib.Path) -> dict[str, set[str]]:
  """{module: modules of the same package that it names in an import, anywhere in its file but
  below `if TYPE_CHECKING`, which never runs}.
  """
  name = lambda p: ".".join(p.relative_to(root.parent).with_suffix("").parts).removesuffix(
    ".__init__"
  )
  files, found = {name(p): p for p in root.rglob("*.py")}, {}
  for module, path in files.items():
    named = set()
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    tree = ast.parse(path.read_text())
    unread = {
      id(inner)
      for node in ast.walk(tree)
      if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
      for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
      if id(node) in unread:
        continue
      if isinstance(node, ast.Import):
        named |= {a.name for a in node.names}
      elif isinstance(node, ast.ImportFrom):
        parts = package.split(".")
        base = parts[: len(parts) - node.level + 1] if node.level else []
        base = ".".join(base + ([node.module] if node.module else []))
        named |= {
          whole if (whole := f"{base}.{a.name}") in files else base for a in node.names
        }  # a module of a package, or a name of it
    found[module] = {n for n in named if n in files and n != module}
  return found


def cycles(graph: dict[str, set[str]]) -> list[list[str]]:
  """Modules that reach one another, each set sorted."""
  names = sorted(graph)
  edges = np.array([[b in graph[a] for b in names] for a in names])
  _, of = connected_components(edges, connection="strong")
  groups = [[names[i] for i in np.flatnonzero(of == g)] for g in range(of.max() + 1)]
  return sorted(g for g in groups if len(g) > 1)


def test_a_cycle_inside_functions_is_found(tmp_path):
  root = tmp_path / "house"
  (root / "room").mkdir(parents=True)
  (root / "__init__.py").write_text("")
  (root / "room/__init__.py").write_text("from . import a\n")
  (root / "room/a.py").write_text("def f():\n  from house.room.b import g\n")
  (root / "room/b.py").write_text("import house.c\n")
  (root / "c.py").write_text("def g():\n  from .room import a\n  import json\n")
  (root / "d.py").write_text("from house.room import a, b\n")
  graph = imports(root)
  assert graph["house.d"] == {"house.room.a", "house.room.b"}
  assert cycles(graph) == [["house.c", "house.room.a", "house.room.b"]]


def test_the_package_has_no_cycle():
  graph = imports(ROOT)
  assert len(graph) > 50 and cycles(graph) == []
