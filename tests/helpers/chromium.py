"""Pages in a real browser, without a network: what they say after their scripts have run, and what they complain of."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

REQUIRED = "VIBENCH_NEEDS_BROWSER"
"""Where this is set, a missing browser is a failure."""

BEFORE = """<script>
window.seen = [];
addEventListener("error", event => window.seen.push(String(event.message)), true);
</script>"""

AFTER = """<script>
addEventListener("load", () => {
  const observed = (() => { %s })();
  const out = document.createElement("pre");
  out.id = "observed";
  out.textContent = JSON.stringify({ ...observed, errors: window.seen });
  document.body.append(out);
});
</script></body>"""


BROWSERS = ("chromium", "chromium-browser", "google-chrome")
"""Names under which it is installed."""


def program(package: str, *names: str) -> str:
    """A program on this machine, by any of its names; the test is skipped, or fails where one is required, without."""
    found = next(filter(None, map(shutil.which, names)), None)
    if found is None:
        reason = f"{names[0]} is not installed, which Debian's package '{package}' provides"
        if os.environ.get(REQUIRED):
            pytest.fail(reason)
        pytest.skip(reason)
    return found


def observed(page: Path, script: str, scratch: Path, *, width: int = 1280, fragment: str = "") -> dict[str, Any]:
    """What a script returns on a page once it is loaded, with the errors that the page has seen.

    The page is opened where it is, so that its links and sources are its own; nothing may be said on the console.
    """
    browser = program("chromium", *BROWSERS)
    text = page.read_text(encoding="utf-8")
    probed = page.with_name(f"probed-{page.name}")
    probed.write_text(text.replace("<head>", "<head>" + BEFORE).replace("</body>", AFTER % script), encoding="utf-8")
    command = [
        browser, "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom",
        f"--window-size={width},900", f"--user-data-dir={scratch / 'profile'}", "--virtual-time-budget=5000",
        "--host-resolver-rules=MAP * ~NOTFOUND", probed.absolute().as_uri() + fragment,
    ]  # fmt: skip
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    finally:
        probed.unlink()
    assert not [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    found = re.search(r'<pre id="observed">(.*?)</pre>', done.stdout, re.DOTALL)
    assert found, "the page's load event never came"
    return dict(json.loads(found[1].replace("&gt;", ">").replace("&lt;", "<").replace("&amp;", "&")))
