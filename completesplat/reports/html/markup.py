"""HTML from nested elements: text is escaped unless it is an element already."""

from html import escape

EMPTY = {"img", "meta", "link", "br"}
"""Elements that have no end tag."""


class Html(str):
    """Text that is HTML. Everything else is plain text, whatever characters it holds."""


def element(name: str, /, *children: str, **attributes: str | int | bool) -> Html:
    """`<name attribute="value">children</name>`.

    Args:
        name: of the element.
        children: elements, or plain text.
        attributes: `class_` for `class`, `aria_label` for `aria-label`; True for one without a value, False for none.
    """
    given = [(key.rstrip("_").replace("_", "-"), value) for key, value in attributes.items() if value is not False]
    opened = "".join(f" {key}" if value is True else f' {key}="{escape(str(value))}"' for key, value in given)
    if name in EMPTY:
        return Html(f"<{name}{opened}>")
    return Html(f"<{name}{opened}>{joined(*children)}</{name}>")


def joined(*children: str) -> Html:
    """Elements and plain text, one after the other."""
    return Html("".join(child if isinstance(child, Html) else escape(child) for child in children))


def scrollable(name: str, *children: str) -> Html:
    """A box that scrolls sideways by itself, also by keyboard, when its content is wider than the page.

    Args:
        name: what it holds, for those who do not see it.
        children: its content.
    """
    return element("div", *children, class_="scroll", tabindex="0", role="region", aria_label=name)


def folded(summary: str, *children: str, open_: bool = False) -> Html:
    """A part that is shown when its summary is clicked."""
    return element("details", element("summary", summary), *children, open=open_)


def described(pairs: dict[str, str]) -> Html:
    """Names and values, as a list; what is empty is left out."""
    parts = [element("div", element("dt", name), element("dd", value)) for name, value in pairs.items() if value]
    return element("dl", *parts)
