"""Text of a file, a scene or a command is text in the report, never markup: by a parser, and in a browser if there is one."""

import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest

from lingo_mi.report.data import ReportData
from lingo_mi.report.page import write_report

RUN = 'document.documentElement.dataset.ran=1'
MARKUP = (
    f'<script>{RUN}</script>',
    f'"><img src=x onerror="{RUN}">',
    f"'><svg onload='{RUN}'>",
    f'</title><script>{RUN}</script>',
    f'</pre></style><body onload={RUN}>&lt;b&gt;',
    f'\udcff<iframe src="javascript:{RUN}">',
)
BROWSERS = 'chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable', 'chrome'


def page(folder, markup):
    """A report that has the markup wherever a user's text may stand."""
    metrics = dict(psnr_3d=30.0, method=markup, variant=markup, versions={markup: markup}, note=markup) | {
        markup: markup
    }
    volume = np.linspace(0, 1, 512).reshape(8, 8, 8)
    return write_report(
        folder, ReportData(title=markup, metrics=metrics, volume=volume, spacing=(1, 1, 1), command=markup)
    )


class Reader(HTMLParser):
    """The tags, the attributes that may act, the scripts, and the text of a page that a reader sees."""

    def __init__(self):
        super().__init__()
        self.tags, self.active, self.scripts, self.text, self.inside = [], [], [], '', ''

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.inside = tag
        self.active += [(k, v) for k, v in attrs if k.startswith('on') or k in ('src', 'href', 'srcdoc', 'style')]

    def handle_endtag(self, tag):
        self.inside = ''

    def handle_data(self, data):
        if self.inside == 'script':
            self.scripts.append(data)
        elif self.inside != 'style':
            self.text += data


def read(path):
    reader = Reader()
    reader.feed(path.read_text(encoding='utf-8'))
    return reader


@pytest.fixture(scope='module')
def plain(tmp_path_factory):
    return read(page(tmp_path_factory.mktemp('plain'), 'plain'))


@pytest.mark.parametrize(
    'markup', [pytest.param(m, marks=() if m in MARKUP[:2] else pytest.mark.thorough) for m in MARKUP]
)
def test_markup_is_text(tmp_path, plain, markup):
    """The page has the tags, the active attributes and the scripts of one without markup."""
    document = read(page(tmp_path, markup))
    assert document.tags == plain.tags and document.active == plain.active == [('href', '#main')]
    assert len(document.scripts) == len(plain.scripts) and document.scripts[-1] == plain.scripts[-1]
    assert document.text.count(markup.replace('\udcff', '\\udcff')) >= 7  # title, heading, command, and the settings


def dom(path, home):
    """Return a page after a browser has loaded it, as HTML."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip(f'no browser is installed: none of {", ".join(BROWSERS)}')
    options = (
        '--headless',
        '--no-sandbox',
        '--disable-gpu',
        '--dump-dom',
        f'--user-data-dir={home}',
        '--virtual-time-budget=500',
    )
    done = subprocess.run([browser, *options, path.as_uri()], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.thorough
def test_no_script_runs_in_a_browser(tmp_path):
    """A page with a script of its own shows that one would be seen."""
    control = tmp_path / 'control.html'
    control.write_text(f'<!doctype html><html><body><script>{RUN}</script></body></html>')
    assert 'data-ran' in dom(control, tmp_path / 'home').partition('>')[2].partition('>')[0]
    for markup in MARKUP:
        document = dom(page(tmp_path, markup), tmp_path / 'home')
        root = document.partition('<head>')[0]
        assert 'data-ran' not in root and 'data-ready' in root and '<h1>' in document and '<iframe' not in document
