"""A page in headless Chromium, driven by Playwright. Tests that need it are skipped, with a reason, where either is missing."""

import contextlib
import re
import shutil

import pytest

BROWSERS = 'chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable', 'chrome'

OURS = 'GPU stall', 'willReadFrequently'  # of pictures that tests read back

# Of every visible element with text of its own: its ratio of contrast (WCAG 2.2, 1.4.3) where that is below what AA asks.
CONTRAST = """() => {
  const numbers = (c) => (c.match(/[\\d.]+/g) || []).map(Number);
  const light = ([r, g, b]) => [r, g, b].map((v) => v / 255).map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4))
    .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  const ground = (e) => {
    for (let at = e; at; at = at.parentElement) {
      const c = numbers(getComputedStyle(at).backgroundColor);
      if (c.length === 3 || c[3] > 0.99) return c;
    }
    return [255, 255, 255];
  };
  const out = [];
  let looked = 0;
  for (const e of document.querySelectorAll('body *')) {
    if (!e.checkVisibility() || ['SCRIPT', 'OPTION', 'CANVAS'].includes(e.tagName)) continue;
    if (![...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim())) continue;
    looked += 1;
    const style = getComputedStyle(e);
    const [a, b] = [light(numbers(style.color)), light(ground(e))].sort((x, y) => y - x);
    const ratio = (a + 0.05) / (b + 0.05);
    const size = parseFloat(style.fontSize);
    const large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
    if (ratio < (large ? 3 : 4.5)) out.push([e.tagName, e.textContent.trim().slice(0, 30), ratio]);
  }
  return { looked, low: out };
}"""


@contextlib.contextmanager
def browser():
    """Headless Chromium, with WebGL in software."""
    api = pytest.importorskip('playwright.sync_api', reason='Playwright is not installed: pip install -e .[browser]')
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip(f'no browser is installed: none of {", ".join(BROWSERS)}')
    options = ['--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader']
    with api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=program, args=options)
        try:
            yield opened
        finally:
            opened.close()


@contextlib.contextmanager
def opened(browser, address, dark=False, offline=True, ready=True, first=''):
    """A page, its network off, that must leave no error and no warning in the console, and ask for nothing else.

    first   a script that runs before the page's scripts

    `page.messages` are the errors and warnings so far, `page.addresses` the addresses of its requests.
    """
    messages, asked = [], []
    scheme = 'dark' if dark else 'light'
    context = browser.new_context(offline=offline, viewport=dict(width=1280, height=900), color_scheme=scheme)
    try:
        page = context.new_page()
        page.set_default_timeout(60_000)
        page.on(
            'console',
            lambda m: m.type in ('error', 'warning') and not any(o in m.text for o in OURS) and messages.append(m.text),
        )
        page.on('pageerror', lambda error: messages.append(str(error)))
        page.on('request', lambda request: asked.append(request.url))
        page.add_init_script(first)
        page.goto(address)
        if ready:
            page.wait_for_selector('html[data-ready]')
        page.addresses, page.messages = asked, messages
        yield page
        assert messages == []
    finally:
        context.close()


def readout(page, row='crosshair'):
    """The texts of a row of the table below the slices, by the names of its columns. Wait until the crosshair's row has a
    place."""
    if row == 'crosshair':
        page.locator('.readout tr[data-row=crosshair] td[data-name=voxel]', has_text=re.compile(r'\d')).wait_for()
    cells = page.locator(f'.readout tr[data-row={row}] td')
    return {cell.get_attribute('data-name'): cell.text_content() for cell in cells.all()}
