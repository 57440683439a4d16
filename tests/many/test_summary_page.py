"""The page over many jobs in a browser: a click sorts, words and numbers filter."""

from __future__ import annotations

from pathlib import Path

import pytest
from browser import CHROMIUM, said, start_browser

from femsense.many.outcome import JobStatus, Outcome
from femsense.many.summary import write_summary

SCRIPT = """
const page = await opened.newPage();
const errors = [];
page.on('pageerror', (error) => errors.push(String(error)));
await page.goto(given[0]);
const names = () => page.$$eval('#jobs tbody tr td:first-child', (cells) => cells.map((cell) => cell.textContent));
const found = { first: await names() };
await page.click('text=rms_m'); found.up = await names();
await page.click('text=rms_m'); found.down = await names();
await page.fill('input', 'rms_m>0.0015'); found.large = await names();
await page.fill('input', 'sigsegv'); found.words = await names();
await page.fill('input', ''); await page.selectOption('select', 'crashed'); found.crashed = await names();
console.log(JSON.stringify({ ...found, errors }));
await opened.close();
"""


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_the_table_is_sorted_and_filtered(tmp_path: Path, pytestconfig: pytest.Config) -> None:
    outcomes = [
        Outcome("b", JobStatus.DONE, row={"rms_m": 2e-3}),
        Outcome("a", JobStatus.DONE, row={"rms_m": 1e-3}),
        Outcome("c", JobStatus.CRASHED, "its worker was ended by SIGSEGV", deaths=2),
    ]
    write_summary(tmp_path, "calibrate", outcomes, {o.name: tmp_path / o.name for o in outcomes})
    browser = start_browser(pytestconfig, SCRIPT, (tmp_path / "summary.html").as_uri())
    assert said(browser) == {
        "first": ["b", "a", "c"],
        "up": ["a", "b", "c"],
        "down": ["b", "a", "c"],
        "large": ["b"],
        "words": ["c"],
        "crashed": ["c"],
        "errors": [],
    }
    browser.wait()
