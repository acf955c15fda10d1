"""Documents read by the parser in C are those of the parser in Python, whose sentences people are told."""

import pytest
import yaml

from nlights_core import yaml_documents
from nlights_core.configurations import shipped
from nlights_core.yaml_documents import Document

TEXTS = [
    "artwork: {id: 0012, title: 'é: ü'}\ntiles:\n  - {name: a, origin_mm: [0, -1.5]}\n",
    "id: 1785 # a year\nwords: [no, ~, 1:30, 2024-05-01, 1e3, .inf]\nlong: >-\n  one\n  two\n",
    '\ufeff"a b": "x\\ty"\r\n? c\r\n: d\r\n',
    "",
    *(
        path.read_text(encoding="utf-8")
        for kind in ("stands", "recipes")
        for path in sorted(shipped(kind).glob("*.yaml"))
    ),
]


@pytest.fixture
def slow(monkeypatch):
    """Read with the parser in Python alone."""

    def read(*arguments):
        with monkeypatch.context() as patch:
            patch.setattr(yaml_documents, "_LOADERS", yaml_documents._LOADERS[-1:])
            return Document(*arguments)

    return read


@pytest.mark.skipif(not yaml.__with_libyaml__, reason="PyYAML was built without the parser in C")
@pytest.mark.parametrize("text", TEXTS)
def test_both_parsers_read_the_same_values_on_the_same_lines(text, slow, monkeypatch):
    texts = [("id",), ("artwork", "id")]
    expected = slow(text, texts)
    # Whatever the parser in C refuses would be read by the other.
    monkeypatch.setattr(yaml_documents, "_LOADERS", yaml_documents._LOADERS[:1])
    found = Document(text, texts)
    assert repr(found.data) == repr(expected.data)
    for location in [("artwork", "title"), ("tiles", 0, "origin_mm"), ("long",), ("lamps",), ("c",)]:
        assert text == "" or found.line(location) == expected.line(location)


@pytest.mark.parametrize(
    "text",
    [
        "a: [1",
        "a: *b",
        "a: !x y",
        "a: 1\na: 2",
        "a: 'x",
        "1785#3: {",
        "a: 012 #3",
        "[" * 40 + "]" * 40,
    ],
)
def test_sentences_of_what_is_refused_are_those_of_the_parser_in_python(text, slow):
    with pytest.raises(yaml.MarkedYAMLError) as expected:
        slow(text, [("a",)])
    with pytest.raises(yaml.MarkedYAMLError) as found:
        Document(text, [("a",)])
    assert found.value.problem == expected.value.problem
    assert str(found.value.problem_mark) == str(expected.value.problem_mark)


def test_half_a_letter_is_refused_as_before(slow):
    for read in (slow, Document):
        with pytest.raises(yaml.reader.ReaderError, match="special characters are not allowed"):
            read("a: \ud800")
