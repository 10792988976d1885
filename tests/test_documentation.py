"""The code and links of the pages: Python that compiles, and names and files that exist."""

import ast
import csv
import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

import lingo_mi as lm

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted((ROOT / 'docs').rglob('*.md'))]
FENCED = re.compile(r'^```(\w+)\n(.*?)^```', re.MULTILINE | re.DOTALL)

each_page = pytest.mark.parametrize('page', PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())


@each_page
def test_python_compiles_and_names_what_the_package_has(page):
    for language, code in FENCED.findall(page.read_text(encoding='utf-8')):
        if language == 'python':
            used = re.findall(r'\blm\.(\w+)', code)
            assert ast.parse(code) and set(used) <= set(lm.__all__), code


@each_page
def test_studies_and_scripts_are_there(page):
    text = page.read_text(encoding='utf-8')
    for study in re.findall(r'python -m (studies(?:\.\w+)+)', text):
        assert study == 'studies.NAME' or importlib.util.find_spec(study), study
    for script in re.findall(r'\b(?:docs|scripts|examples)/\w+\.py\b', text):
        assert (ROOT / script).exists(), script


@each_page
def test_links_lead_to_files(page):
    text = FENCED.sub('', page.read_text(encoding='utf-8'))
    for target in re.findall(r'\]\(([^)#\s]+)[^)]*\)', text):
        if '://' not in target:
            assert (page.parent / target).exists(), target


@pytest.mark.parametrize(
    ('row', 'table', 'chosen'), [('new views', 'views', None), ('volumes (ASD-POCS)', 'ct', 'asd-pocs')]
)
def test_leads_of_lingo_follow_from_the_tables(row, table, chosen):
    with (ROOT / f'docs/tables/{table}.csv').open(encoding='utf-8') as file:
        cells = [cell for cell in csv.DictReader(file) if cell.get('algorithm') == chosen]
    leads = []
    for views in ('5', '10', '25'):
        objects = [
            cell for cell in cells if cell['views'] == views and not cell['object'].startswith(('mean', 'paper'))
        ]
        lead = np.array([float(cell['lingo PSNR']) - float(cell['r2 PSNR']) for cell in objects])
        leads.append(f'{lead.mean():.2f} ± {lead.std(ddof=1) / len(lead) ** 0.5:.2f}')
    page = (ROOT / 'docs/benchmarks/paper.md').read_text(encoding='utf-8')
    assert f'| {row} | {" | ".join(leads)} |' in page
