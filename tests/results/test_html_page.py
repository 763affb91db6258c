"""HTML from elements: text is text."""

from html.parser import HTMLParser

import pytest

from completesplat.results.html_page import Html, element, joined


def parsed(text: str) -> list:
    events: list = []
    parser = HTMLParser()
    parser.handle_starttag = lambda tag, attributes: events.append((tag, dict(attributes)))
    parser.handle_endtag = lambda tag: events.append(f"/{tag}")
    parser.handle_data = lambda data: events.append(data)
    parser.feed(text)
    parser.close()
    return events


@pytest.mark.parametrize("text", ["<b>", "&amp;", "\"'", "</p><script>", "ä €"])
def test_text_and_attributes_come_back_as_they_were(text):
    assert parsed(element("p", text, title=text)) == [("p", {"title": text}), text, "/p"]


def test_elements_nest_and_only_they_are_not_escaped():
    inner = element("b", "x", class_="a", aria_label="b", open=True, hidden=False)
    start = ("b", {"class": "a", "aria-label": "b", "open": None})
    assert isinstance(inner, Html)
    assert parsed(element("p", inner, str.__str__("<b>"))) == [("p", {}), start, "x", "/b", "<b>", "/p"]
    assert joined(element("b"), "<") == "<b></b>&lt;"
