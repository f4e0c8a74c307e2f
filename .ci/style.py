#!/usr/bin/env python3
"""How is the code written? Figures of style, to be read beside those of other packages.

    python .ci/style.py [numpyro_bridges] [FOLDER of another package]

A JSON line for each folder. `comments`: lines with a comment for 100 lines of code; docstrings
count as neither. `packed`: assignments `a, b = x, y` for 1000 statements. `complex`: functions of a
cyclomatic number above 15, where each branch, loop, comprehension and operand of `and` or `or`
counts. What a number hides is not in it: read the code.
"""

import ast
import io
import json
import statistics
import sys
import tokenize
from pathlib import Path

WIDTH = 100
BRANCHES = (ast.If, ast.For, ast.While, ast.IfExp, ast.ExceptHandler, ast.comprehension)
CODE = (tokenize.NAME, tokenize.OP, tokenize.NUMBER, tokenize.STRING)


def docstring_lines(tree: ast.Module) -> set[int]:
    """Lines of strings that stand alone: docstrings, those of attributes too."""
    lines: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            lines.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return lines


def is_packed(node: ast.AST) -> bool:
    if not isinstance(node, ast.Assign) or not isinstance(node.value, ast.Tuple):
        return False
    return isinstance(node.targets[0], ast.Tuple)


def cyclomatic(function: ast.FunctionDef) -> int:
    number = 1
    for node in ast.walk(function):
        number += isinstance(node, BRANCHES)
        if isinstance(node, ast.BoolOp):
            number += len(node.values) - 1
    return number


def figures(folder: Path) -> dict[str, object]:
    files: list[int] = []
    functions: list[int] = []
    complex_functions: list[str] = []
    code = comments = statements = packed = long_lines = 0
    for path in sorted(folder.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        strings = docstring_lines(tree)
        tokens = list(tokenize.generate_tokens(io.StringIO(text).readline))
        files.append(text.count("\n"))
        long_lines += sum(len(line) > WIDTH for line in text.splitlines())
        comments += sum(token.type == tokenize.COMMENT for token in tokens)
        code += len({token.start[0] for token in tokens if token.type in CODE} - strings)
        for node in ast.walk(tree):
            statements += isinstance(node, ast.stmt) and node.lineno not in strings
            packed += is_packed(node)
            if isinstance(node, ast.FunctionDef):
                functions.append((node.end_lineno or node.lineno) - node.lineno + 1)
                if cyclomatic(node) > 15:
                    complex_functions.append(f"{path.relative_to(folder)}:{node.name}")
    return {
        "folder": folder.name,
        "files": len(files),
        "file lines, median / max": [statistics.median(files), max(files)],
        "function lines, median / p90 / max": [
            statistics.median(functions),
            sorted(functions)[int(0.9 * len(functions))],
            max(functions),
        ],
        "statements": statements,
        f"lines over {WIDTH}": long_lines,
        "comments": round(100 * comments / code, 1),
        "packed": round(1000 * packed / statements, 1),
        "complex": complex_functions,
    }


if __name__ == "__main__":
    for name in sys.argv[1:] or ["numpyro_bridges"]:
        print(json.dumps(figures(Path(name)), ensure_ascii=False))
