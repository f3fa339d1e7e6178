"""Sentences of pages, docstrings, comments and messages, and what is measured of them."""

import ast
import io
import re
import tokenize

OPENINGS = {"What", "How", "Where", "Whether", "Which", "That", "Who"}
# "That is so." points at something; "That a box is cut ..." is a clause.
POINTING = re.compile(r"That (is|was|are|were|has|had|does|can|may|will|makes?|needs?|of|one|with|without)\b")
END = re.compile(r"(?<=[.!?:;])[\"')\]*_]*\s+(?=[\"'(\[*_`$]*[A-Z0-9`$\\(])|\n\s*\n")
LINK = re.compile(r"!?\[([^\]]*)\]\([^)]*\)")
FENCE = re.compile(r"^(```|~~~).*?^\1\s*$", re.DOTALL | re.MULTILINE)


def words(sentence):
    """How many words a sentence has; code is one, numbers and signs are none."""
    return sum(bool(re.search(r"[A-Za-z]", word)) for word in re.sub(r"`[^`]*`", "code", sentence).split())


def opens_with_a_clause(sentence):
    """Whether a noun clause stands at the beginning; questions may begin so."""
    start = re.sub(r"^[\W_]+", "", sentence)
    asks = sentence.rstrip("*_\"') ").endswith("?")
    return start.split(" ")[0].rstrip(",") in OPENINGS and not asks and not POINTING.match(start)


def of_text(text):
    """Sentences: they end with . ! ? : or ; before a capital, or with an empty line."""
    text = re.sub(r"\b(e\.g|i\.e|cf|vs|et al|Eq|Fig|No)\.", r"\1", text)
    return [" ".join(one.split()) for one in END.split(text) if one and re.search(r"[a-zA-Z]{2}", one)]


def of_page(text):
    """The sentences of a page's paragraphs, without code, tables, headings, equations and the targets of links."""
    text = re.sub(r"<!--.*?-->", "", FENCE.sub("\n\n", text), flags=re.DOTALL)
    text = re.sub(r"\$\$.*?\$\$", " E ", text, flags=re.DOTALL)
    text = re.sub(r"^(#.*|\|.*|:::.*|!!!.*|!\[.*|\s{4,}\S.*)$", "", text, flags=re.MULTILINE)
    text = re.sub(r"^\s*([*-]|\d+\.) ", "\n\n", text, flags=re.MULTILINE)
    return of_text(LINK.sub(r"\1", re.sub(r"\$[^$]*\$", "E", text)))


def of_cells(text):
    """The sentences in the cells of a page's tables."""
    rows = re.findall(r"^\|(.*)\|$", FENCE.sub("", text), re.MULTILINE)
    cells = [cell for row in rows for cell in re.split(r"(?<!\\)\|", LINK.sub(r"\1", re.sub(r"\$[^$]*\$", "E", row)))]
    return [sentence for cell in cells for sentence in of_text(cell)]


def of_docstring(text):
    """The sentences of a docstring, without its indented examples, outlines, and the names of its arguments."""
    lines = []
    for line in text.splitlines():
        indented, item = re.match(r"\s{4,}\S", line), re.match(r"\s*(\* |\w+(\.\w+)*:(\s|$)|\S+( \S+)*\s{2,}\S)", line)
        if indented and not (lines and lines[-1]):
            continue
        if item:
            lines.append("")
        lines.append(line[item.end(1) :].strip() if item and item[1].endswith(": ") else line.strip())
    return of_text("\n".join(lines))


def docstrings(tree):
    """(line, text) of modules, classes, functions, and of fields: each string that stands alone."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.lineno, node.value.value


def comments(source):
    """(line, text) of each comment, with its next lines."""
    found = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and not re.match(r"#\s*(noqa|type:|fmt:|!)", token.string):
            line, text = token.start[0], token.string.lstrip("# ")
            alone = token.line.lstrip().startswith("#")
            if alone and found and found[-1][1:3] == (line - 1, True):
                found[-1] = (found[-1][0], line, True, f"{found[-1][3]} {text}")
            else:
                found.append((line, line, alone, text))
    return [(start, text) for start, _, _, text in found]


def messages(tree):
    """(line, text) of texts that functions are given, such as errors, with X for each value that is filled in."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            for one in (*node.args, *(keyword.value for keyword in node.keywords)):
                parts = one.values if isinstance(one, ast.JoinedStr) else [one]
                texts = [part.value if isinstance(part, ast.Constant) else "X" for part in parts]
                if all(isinstance(text, str) for text in texts) and " " in "".join(texts):
                    yield one.lineno, "".join(texts)
