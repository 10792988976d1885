"""Take the pictures of the page `how_to/look.md`: screenshots of report.html and compare.html in headless Chromium.

pip install -e '.[browser]'
lingo-mi fit x3d_foot --views 25 --iterations 300 --out out/fast
lingo-mi fit x3d_foot --views 25 --iterations 100 --method lingo --out out/lingo
python docs/make_report_pictures.py out/fast out/lingo
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import sync_playwright

FIGURES = Path(__file__).parent / 'figures'


def main(fast: str, lingo: str) -> None:
    program = next(filter(None, map(shutil.which, ('chromium', 'chromium-browser', 'google-chrome'))))
    options = ['--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader']
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        compared = Path(folder) / 'compare.html'
        subprocess.run(['lingo-mi', 'compare', fast, lingo, '--out', str(compared)], check=True)
        browser = playwright.chromium.launch(executable_path=program, args=options)
        page = browser.new_page(viewport=dict(width=1280, height=1420), color_scheme='dark')
        page.goto((Path(fast) / 'report.html').resolve().as_uri())
        page.wait_for_selector('html[data-ready]', timeout=120_000)
        page.keyboard.press('c')
        page.get_by_role('button', name='Outer surface').click()
        page.evaluate('scrollTo(0, 0)')
        page.wait_for_timeout(3000)
        page.screenshot(path=FIGURES / 'report.png')
        page = browser.new_page(viewport=dict(width=1280, height=1130))
        page.goto(compared.as_uri())
        page.wait_for_selector('html[data-ready]', timeout=120_000)
        page.keyboard.press('s')
        page.wait_for_timeout(3000)
        page.screenshot(path=FIGURES / 'compare.png')
        browser.close()


if __name__ == '__main__':
    main(*sys.argv[1:])
