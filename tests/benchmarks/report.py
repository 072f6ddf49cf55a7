"""What reports of large runs take: seconds to write, megabytes, and seconds until Chromium has opened them.

    python tests/benchmarks/report.py FOLDER [RUN]

Results of 704 cells with 32 queries each and of 20,000 cells with one are made of the cells of RUN, a run of the study
`quick` (FOLDER/quick by default, which is run where it is missing). Printed are also CPU seconds and the memory of the
largest process. The command ends with exit code 1 if the report of 704 cells takes ten seconds to write, five
megabytes, or two seconds to open, or if one of the pages does not open.
"""

import resource
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))

from browsing import chromium, complaints, look
from cells import seconds_of
from many_cells import write_many

from vibench.results.sqlite import FILE

SIZES = {704: 32, 20_000: 1}
"""Cells, and queries of each."""

SECONDS_TO_WRITE, MEGABYTES, SECONDS_TO_OPEN = 10.0, 5.0, 2.0
"""What the report of 704 cells has to stay under."""

OPENED = """
const [entry] = performance.getEntriesByType("navigation");
return [entry.loadEventEnd / 1e3, document.querySelectorAll('[data-table="summary"] tbody tr').length];
"""


def command(*arguments: str) -> tuple[float, float]:
    start = time.perf_counter()
    used = seconds_of(*arguments)
    return time.perf_counter() - start, used


def opened(page: Path, folder: Path) -> float:
    """Seconds from the beginning of the navigation to the end of the load event, the script included."""
    with chromium(folder) as browser:
        look(browser, page)
        seconds, rows = browser.execute_script(OPENED)
        wrong = complaints(browser)
        if not rows or wrong:
            raise SystemExit(f"'{page}' does not open: {rows} rows, {wrong}")
        return float(seconds)


def main() -> int:
    folder = Path(sys.argv[1])
    run = Path(sys.argv[2]) if len(sys.argv) > 2 else folder / "quick"
    if not (run / FILE).exists():
        command("run", "quick", "--out", str(run), "--no-figures")
    missed = False
    for cells, queries in SIZES.items():
        results = folder / str(cells)
        if not (results / FILE).exists():
            write_many(run, results, cells, queries)
        page = results / "report.html"
        written, used = command("report", str(results), "--out", str(page))
        most = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20  # of one process, in KiB on Linux
        size, seconds = page.stat().st_size / 1e6, opened(page, folder)
        taken = f"{written:.1f} s to write ({used:.1f} s of CPU, {most:.1f} GiB)"
        print(f"{cells} cells: {taken}, {size:.2f} MB, {seconds:.2f} s to open", flush=True)
        asked = written < SECONDS_TO_WRITE and size < MEGABYTES and seconds < SECONDS_TO_OPEN
        missed |= cells == min(SIZES) and not asked
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
