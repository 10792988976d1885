"""How long a frame of report.html takes in headless Chromium without a GPU: the limits of the page `how_to/look.md`.

pip install -e '.[browser]'
lingo-mi fit x3d_foot
python docs/measure_frames.py out/x3d_foot/report.html
"""

import shutil
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

FRAMES = 12
# Milliseconds a frame, mean over acts that are each followed by a frame.
MEASURE = """async ([act, count]) => {
  const frame = () => new Promise((done) => requestAnimationFrame(done));
  const press = (at, key) => at.dispatchEvent(new KeyboardEvent('keydown', { key, bubbles: true, cancelable: true }));
  const slice = document.querySelector('[data-axis="2"]');
  const stage = document.querySelector('#space .stage');
  const level = document.querySelector('#slices input[type=range]');
  const acts = {
    slice: () => press(slice, 'PageUp'),
    crosshair: () => press(slice, 'ArrowLeft'),
    level: (i) => { level.value = Number(level.value) * (i % 2 ? 1.01 : 0.99); level.dispatchEvent(new Event('input')); },
    turn: () => press(stage, 'ArrowLeft'),
  };
  await frame();
  const began = performance.now();
  for (let i = 0; i < count; i++) { acts[act](i); await frame(); }
  return (performance.now() - began) / count;
}"""


def main(report: Path) -> None:
    program = next(filter(None, map(shutil.which, ('chromium', 'chromium-browser', 'google-chrome'))))
    options = ['--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader']
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=options)
        page = browser.new_page(viewport=dict(width=1280, height=900))
        page.set_default_timeout(300_000)
        page.goto(report.resolve().as_uri())
        page.wait_for_selector('html[data-ready]')

        def row(name, act):
            print(f'| {name} | {page.evaluate(MEASURE, [act, FRAMES]):.0f} |', flush=True)

        print(f'| | Chromium {browser.version}, {report.stat().st_size / 1e6:.1f} MB: ms a frame |\n|---|---:|')
        for name, act in (('another slice', 'slice'), ('crosshair', 'crosshair'), ('window and level', 'level')):
            row(name, act)
        page.locator('#space').scroll_into_view_if_needed()
        page.wait_for_timeout(4000)
        row('3D turned: points', 'turn')
        for name, part in (
            ('with a surface', 'Outer surface'),
            ('with both', 'Inner surface'),
            ('with ellipsoids, too', 'Ellipsoids'),
        ):
            page.get_by_role('button', name=part).click()
            page.wait_for_timeout(4000)
            row(name, 'turn')
        browser.close()


if __name__ == '__main__':
    main(Path(sys.argv[1]))
