"""Lines of code, without docstrings, comments and blank lines: `make size` prints those of package and tests."""

import ast
import io
import sys
import tokenize
from pathlib import Path

NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def lines_of_code(text: str) -> int:
    """Return the number of lines with code, which a docstring of a module, class or function is not."""
    tokens = [token for token in tokenize.generate_tokens(io.StringIO(text).readline) if token.type not in NO_CODE]
    lines = {line for token in tokens for line in range(token.start[0], token.end[0] + 1)}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node) is not None:
            lines -= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    return len(lines)


def size(folder: Path) -> tuple[int, int]:
    """Return the lines of code, and all lines, of the modules in a folder."""
    texts = [path.read_text() for path in folder.rglob("*.py")]
    return sum(map(lines_of_code, texts)), sum(len(text.splitlines()) for text in texts)


if __name__ == "__main__":
    for name in sys.argv[1:]:
        code, lines = size(Path(name))
        print(f"{name}: {code:,} lines of code, {lines:,} lines")
