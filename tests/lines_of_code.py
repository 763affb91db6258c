"""Lines of code and how dense they are: `make size` prints those of package and tests.

Dense code is counted per 1,000 lines of code, which are lines without docstrings, comments and blank lines. The counts
are a report and no test fails by them.
"""

import ast
import io
import sys
import tokenize
from collections import Counter
from pathlib import Path

NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
LITERAL = ast.Tuple | ast.List | ast.Set | ast.Dict | ast.DictComp | ast.IfExp

PACKED = "`a, b = x, y`"
WALRUS = "walrus"
HANDLERS = "`except`"
UNPACKED = "unpacked literals"
DENSE = [PACKED, WALRUS, HANDLERS, UNPACKED]


def lines_of_code(text: str) -> int:
    """Return the number of lines with code, which a docstring of a module, class or function is not."""
    tokens = [token for token in tokenize.generate_tokens(io.StringIO(text).readline) if token.type not in NO_CODE]
    lines = {line for token in tokens for line in range(token.start[0], token.end[0] + 1)}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node) is not None:
            lines -= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    return len(lines)


def kinds(node: ast.AST) -> list[str]:
    """Return which kinds of dense code a node of the syntax tree is; a dict counts once for each literal in it."""
    match node:
        case ast.Assign(targets=[ast.Tuple()], value=ast.Tuple()):
            return [PACKED]
        case ast.NamedExpr():
            return [WALRUS]
        case ast.ExceptHandler():
            return [HANDLERS]
        case ast.Starred(value=value) if isinstance(value, LITERAL):
            return [UNPACKED]
        case ast.AugAssign(op=ast.BitOr(), value=value) if isinstance(value, ast.Dict | ast.DictComp):
            return [UNPACKED]
        case ast.Dict(keys=keys, values=values):
            unpacked = [value for key, value in zip(keys, values, strict=True) if key is None]
            return [UNPACKED for value in unpacked if isinstance(value, LITERAL)]
    return []


def density(text: str) -> Counter[str]:
    """Count each kind of dense code in the text of a module."""
    return Counter(kind for node in ast.walk(ast.parse(text)) for kind in kinds(node))


def report(folder: Path) -> str:
    """Describe the modules in a folder: lines of code, all lines, and dense code per 1,000 lines of code."""
    texts = [path.read_text() for path in folder.rglob("*.py")]
    code = sum(map(lines_of_code, texts))
    total = sum(map(density, texts), Counter())
    lines = sum(len(text.splitlines()) for text in texts)
    per_thousand = [f"{kind} {1000 * total[kind] / max(code, 1):.1f}" for kind in DENSE]
    return f"{folder}: {code:,} lines of code, {lines:,} lines; per 1,000 lines of code: {', '.join(per_thousand)}"


if __name__ == "__main__":
    for name in sys.argv[1:]:
        print(report(Path(name)))
