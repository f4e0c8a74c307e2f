"""What the builder of the documentation makes of formulas, citations, scripts and docstrings.

CI builds the whole.
"""

import importlib
import re
from io import BytesIO
from pathlib import Path
from xml.etree import ElementTree

import pytest

import numpyro_bridges as nb

pytest.importorskip("mkdocs", reason="the extra `docs` is not installed")
markdown = pytest.importorskip("markdown")

ROOT = Path(__file__).parent.parent
BIBLIOGRAPHY = ROOT / "docs" / "references.bib"
NAMESPACE = "{http://www.w3.org/1998/Math/MathML}"


@pytest.fixture(scope="module")
def builder():
    """A module of `docs/builder` by its name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "docs" / "builder"))
        yield importlib.import_module


@pytest.fixture(scope="module")
def rendered(builder):
    pages = builder("extension").Pages(BIBLIOGRAPHY)
    extensions = ["pymdownx.arithmatex", "tables", pages]
    arithmatex = {"pymdownx.arithmatex": {"generic": True}}
    return lambda text: markdown.markdown(text, extensions=extensions, extension_configs=arithmatex)


def formula(page):
    return ElementTree.fromstring(re.search(r"<math.*?</math>", page, re.S).group())


def test_mathematics(rendered):
    page = rendered(
        "The law is $x' \\sim N(0, \\Sigma)$, and\n\n$$ \\sum_{k<K} \\log\\frac{p_k}{q_k} . $$\n"
    )
    assert "$" not in page and "\\" not in page
    text = "".join(formula(page).itertext())
    assert text == "x′∼N(0,Σ)"
    assert '<div class="equation"><math' in page and 'display="block"' in page


@pytest.mark.parametrize(
    "tex, tag, text, attributes",
    [
        (r"\tilde h", "mover", "h˜", {"accent": "true"}),
        (r"a \sim b", "mo", "∼", {}),
        (r"|x|", "mo", "|", {"lspace": "0", "rspace": "0", "stretchy": "false"}),
        (r"\left|x\right|", "mo", "|", {"stretchy": "true"}),
        (r"\Psi", "mi", "Ψ", {"mathvariant": "normal"}),
        (r"\psi", "mi", "ψ", {}),
        (r"f(-x)", "mo", "−", {"form": "prefix"}),
        (r"a - x", "mo", "−", {}),
        (r"f(x) - 1", "mo", "−", {}),
    ],
)
def test_settings_of_mathematics(tex, tag, text, attributes, builder):
    tree = ElementTree.fromstring(builder("extension").mathml(tex, "inline"))
    parts = [part for part in tree.iter(NAMESPACE + tag) if "".join(part.itertext()) == text]
    assert parts and all(attributes.items() <= part.attrib.items() for part in parts)
    assert "form" in attributes or all(
        part.get("form") != "prefix" or tex.startswith(r"\left") for part in parts
    )


@pytest.mark.parametrize(
    "tex, spaces", [(r"\log x", 1), (r"2 \log x", 2), (r"2 + \log(x)", 0), (r"\exp", 0)]
)
def test_spaces_of_functions(tex, spaces, builder):
    assert builder("extension").mathml(tex, "inline").count("<mspace") == spaces


def test_citations(rendered):
    page = rendered("As in [@bell1994], but `[@bell1994]` in code, and [a link](there.md).")
    assert '<autoref identifier="bell1994">Bell 1994</autoref>' in page
    assert "<code>[@bell1994]</code>" in page and 'href="there.md"' in page
    assert ">Mider et al. 2021<" in rendered("[@mider2021]")
    with pytest.raises(ValueError, match=r"`\[@nobody1900\]` must be a key"):
        rendered("[@nobody1900]")


def test_bibliography(builder):
    page = builder("extension").bibliography_page(BIBLIOGRAPHY)
    keys = re.findall(r"@\w+\{(\w+),", BIBLIOGRAPHY.read_text(encoding="utf-8"))
    assert sorted(re.findall(r"\{#(\w+)\}", page)) == sorted(keys)
    assert not re.search(r"[\\$]", page)
    assert "**Bell 1994.** Bradley" in page and "Gauss–Newton" in page


def test_every_public_name_has_a_place(builder):
    pages = dict(builder("hooks").reference_pages())
    listed = [
        name
        for page in pages.values()
        for name in re.findall(r"^::: numpyro_bridges\.(\S+)$", page, re.M)
    ]
    assert len(listed) == len(set(listed))
    public = {
        name for name, value in vars(nb).items() if callable(value) and not name.startswith("_")
    }
    assert public <= set(listed)
    assert {
        "infer.PCN",
        "io.read_tps",
        "plot.tree",
        "weights.pareto_k",
        "guiding.AbstractPlan",
    } <= set(listed)
    assert "GuidedBridge" in pages["bridges"] and "compare" in pages["compare"]


def test_tutorial(builder, tmp_path, monkeypatch):
    hooks = builder("hooks")
    monkeypatch.setattr(hooks, "FIGURES", tmp_path)
    (tmp_path / "there.png").write_bytes(b"")
    script = (
        "# %% [markdown]\n# # Title\n#\n#     python script.py\n# ![a](there.png)\n"
        "# ![b](missing.png)\n\n"
        "# %%\nimport numpy  # noqa: E402\n\n\n# %%\n"
    )
    page = hooks.tutorial(script)
    assert (
        page == "# Title\n\n    python script.py\n![a](there.png)\n\n\n```python\nimport numpy\n```"
    )


def test_first_steps(builder):
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    page = builder("hooks").first_steps(readme)
    assert page.startswith("# First steps\n\n## Try it\n")
    assert re.search(r"```python\n.*?```", readme, re.S).group() in page


@pytest.mark.parametrize(
    "page, words",
    [
        ("<p>as in [@bell1994]</p>", "unresolved citation"),
        (r"<p>the law \(x\)</p>", "raw TeX"),
        (r"<p>\[ x = 1 \]</p>", "raw TeX"),
        ("<p>$$ x $$</p>", "raw TeX"),
        ("<mi>\\foo</mi>", "raw TeX"),
        ('<script src="https://elsewhere.example/a.js"></script>', "another host"),
        ('<link rel="stylesheet" href="//elsewhere.example/a.css">', "another host"),
    ],
)
def test_problems(page, words, builder):
    problems = builder("hooks").problems
    assert any(words in problem for problem in problems(page))
    assert list(problems(f"<code>{page}</code>")) == [] or words == "another host"
    assert (
        list(
            problems(
                '<p>Fine.</p><script src="a.js"></script><a href="https://elsewhere.example">x</a>'
            )
        )
        == []
    )


def test_font_has_the_characters_of_formulas(builder):
    font_tools = pytest.importorskip("fontTools.ttLib")
    page = "<p>Ж</p><math><mi>x</mi><mo>&#x02211;</mo><mo>∼</mo></math>"
    font = font_tools.TTFont(BytesIO(builder("fonts").mathematical_font(page)))
    characters = set(font.getBestCmap())
    assert {ord("∑"), ord("∼"), 0x1D465} <= characters and ord("Ж") not in characters
    assert "MATH" in font
