"""Checks and counts of CUDA without a GPU: assembling, counting, the model, the page and the command."""

import subprocess
from collections import Counter

import pytest

from helpers.fits import SHORT, geometry, tiny_scan
from helpers.script import FIT, run
from lingo_mi.common.errors import InputError
from lingo_mi.common.gpu import GPU
from lingo_mi.fitting.loop import run as run_fit
from lingo_mi.validation import cuda_model as model
from lingo_mi.validation.cuda_model import CARDS, Card, counts, largest, predicted, seconds, times
from studies.cell_files import CellFiles
from studies.cuda import assemble, measure, report, waits
from studies.cuda.assemble import Kernel, find_ptxas
from studies.cuda.count import KINDS, _counts, difference
from studies.cuda.page import page
from studies.cuda.suite import SHARE, Outcome, all_files, run_tests

CHECK = FIT.with_name('cuda_check.py')
TESTS = FIT.parents[1] / 'tests'
MODULE = """
.version 7.0
.target sm_75
.address_size 64
.visible .entry twice(.param .u64 x) {
    .reg .b64 %rd<2>; .reg .f32 %f<3>;
    ld.param.u64 %rd0, [x];
    ld.global.f32 %f0, [%rd0];
    add.f32 %f1, %f0, %f0;
    st.global.f32 [%rd0], %f1;
    ret;
}
"""


def kernel(launches=1, atomics=0, loads=0, **warp):
    return dict(launches=launches, warp=dict.fromkeys(KINDS, 0) | warp, lanes=0, loads=loads, stores=0, atomics=atomics)


# ---- assembling ------------------------------------------------------------------------------------------------------


@pytest.fixture
def ptxas():
    try:
        return find_ptxas()
    except InputError as error:
        pytest.skip(str(error))


def test_kernels_are_assembled(ptxas, tmp_path):
    (tmp_path / 'good.ptx').write_text(MODULE)
    (tmp_path / 'bad.ptx').write_text(MODULE.replace('add.f32', 'ad.f32').replace('twice', 'broken'))
    (good,), (bad,) = (assemble.assemble(tmp_path / f'{name}.ptx', 75, 'test_a.py') for name in ('good', 'bad'))
    assert (good.name, good.test, good.sm, good.lines) == ('twice', 'test_a.py', 75, 5)
    assert good.error is None and 0 < good.registers < 32 and good.spilled == 0
    assert bad.name == 'broken' and 'ad' in bad.error


def test_no_assembler(monkeypatch):
    monkeypatch.setattr(assemble.sys, 'path', [])
    monkeypatch.setenv('PATH', '')
    with pytest.raises(InputError, match='pip install nvidia-cuda-nvcc'):
        find_ptxas()


# ---- counting --------------------------------------------------------------------------------------------------------


def test_counts_of_a_profile():
    """A block's instructions count for each warp that ran it; moves are left out."""
    blocks = [dict(warps=10, lanes=200, fp32=3, move=7), dict(warps=2, lanes=64, atomic=1)]
    accesses = [dict(kind='a', sectors=5), dict(kind='l', sectors=7), dict(kind='l', sectors=1)]
    totals = _counts(dict(launches=2, threads=64, blocks=blocks, accesses=accesses))
    assert totals['warp']['fp32'] == 30 and totals['warp']['atomic'] == 2 and sum(totals['warp'].values()) == 32
    assert totals['lanes'] == 3 * 200 + 64 and (totals['loads'], totals['stores'], totals['atomics']) == (8, 0, 5)


def test_difference_of_counts():
    more, less = dict(a=kernel(3, fp32=9), b=kernel(1), c=kernel(2, int=4)), dict(a=kernel(1, fp32=2), b=kernel(1))
    actual = difference(more, less)
    assert set(actual) == {'a', 'c'} and actual['a']['launches'] == 2 and actual['a']['warp']['fp32'] == 7


# ---- the model -------------------------------------------------------------------------------------------------------


LISTING = """      Type           Disp Enb Address            What
1       breakpoint     keep y   0x00007ffff59a1f10 cuStreamSynchronize
\tbreakpoint already hit {} times
        ignore next 999999991 hits
2       breakpoint     keep y   <PENDING>          cuEventSynchronize
        ignore next 1000000000 hits
7       breakpoint     keep y   <MULTIPLE>
\tbreakpoint already hit 1 time
7.1                         y   0x00007ffff59a2f10 cuLinkCreate_v2
"""


def test_calls_of_a_step(monkeypatch):
    """They are the differences of what gdb lists after two runs."""
    answers = iter(LISTING.format(hits) for hits in (9, 11))

    def ran(command, **_):
        assert command[:2] == ['PROGRAM', 'gdb'] and command[-1] in ('6', '7')
        return subprocess.CompletedProcess(command, 0, f'[Inferior 1 exited normally]\nNum {next(answers)}', '')

    monkeypatch.setattr(waits.subprocess, 'run', ran)
    assert [*waits.of_a_step('PROGRAM', 'c.npz').values()] == [2, 0, 0, 0]


def test_steps_that_do_not_end(monkeypatch):
    monkeypatch.setattr(
        waits.subprocess, 'run', lambda c, **_: subprocess.CompletedProcess(c, 0, 'Num 1', 'no such file')
    )
    with pytest.raises(InputError, match='c.npz: the steps did not end normally under gdb: no such file'):
        waits.calls('PROGRAM', 'c.npz', 6)


def test_times_of_a_kernel():
    """They agree with numbers by hand for 64 multiprocessors at 1 GHz, 100 GB/s, and the lanes of an A100."""
    card = Card('a card', 64, 1e9, 100e9, 80)
    times_found = times(kernel(fp32=64_000_000, fp64=1_000_000, atomics=47_360_000, loads=3_125_000), card)
    assert times_found['fp32'] == pytest.approx(64e6 * 32 / (64 * 64e9))
    assert times_found['issue'] == pytest.approx(65e6 / (4 * 64e9)) and times_found['fp64'] == pytest.approx(
        32e6 / (32 * 64e9)
    )
    assert times_found['atomics'] == pytest.approx(1e-3) and times_found['memory'] == pytest.approx(1e-3)
    assert seconds(kernel(launches=7), card) == pytest.approx(7 * model.LAUNCH)


def test_times_of_a_fit():
    scan = tiny_scan(geometry())
    measured = measure.measured(run_fit(scan, SHORT), repeats=2)
    for work in measured.values():
        assert work['launches'] > 10 and 0 < work['short'] <= work['launches'] and 0 < work['of_short'] <= work['all']
    assert measured['a step']['seconds'] > 0


def test_times_by_the_model(monkeypatch):
    card = CARDS[2]
    monkeypatch.setattr(
        measure, 'gpu', lambda: GPU(card.name, 0, card.multiprocessors, 64, 90, card.clock, card.bandwidth)
    )
    foot = counts()['foot']
    expected = measure.expected(foot['gaussians'])
    assert expected['a step'] == pytest.approx(1e3 * sum(seconds(kernel, card) for kernel in foot['step']))
    assert expected['image and derivatives'] < expected['a step']
    monkeypatch.setattr(measure, 'gpu', lambda: GPU('unknown', 0, 1, 64, 90, 0, 0))
    assert measure.expected(1000) == {}


def test_consumer_cards_take_longer_for_float64():
    work = kernel(fp64=1_000_000)
    slow, a100, h100 = (times(work, card)['fp64'] for card in CARDS)
    assert slow > 8 * a100 and a100 > h100


def test_predictions():
    """More Gaussians and pairs take more time; the kept counts are complete."""
    predictions = counts()
    assert set(predictions) == {'foot', 'chest', 'giants'}
    for name, parts in predictions.items():
        assert parts['gaussians'] > 0 and parts['boxes'] >= parts['pairs'] > 0
        assert largest(parts['image'])['atomics'] > 0 and ('step' in parts) == (name != 'giants')
    foot = predictions['foot']
    for part in ('image', 'derivatives', 'step'):
        usual = predicted(part, CARDS[0], foot['gaussians'], foot['boxes'])
        assert usual == pytest.approx(sum(seconds(k, CARDS[0]) for k in foot[part]))
        assert predicted(part, CARDS[0], foot['gaussians'], 2 * foot['boxes']) > usual
        assert predicted(part, CARDS[0], 2 * foot['gaussians'], foot['boxes']) > usual


def test_a_line_beside_a_measurement(monkeypatch):
    card = GPU('a card', 8 << 30, 64, 48, 86, 1e9, 100e9)
    monkeypatch.setattr(model, 'gpu', lambda: card)
    assert 'forward: 2.00 ms; predicted for a card: ' in model.beside('forward', 'image', 2e-3, 1000, 1e6)
    monkeypatch.setattr(model, 'gpu', lambda: GPU('a card', 8 << 30, 64, 48, 86, 0, 0))
    assert 'no prediction' in model.beside('forward', 'image', 2e-3, 1000)


def test_tables_of_the_document(tmp_path, monkeypatch):
    document = tmp_path / 'gpu.md'
    document.write_text('<!-- table predicted -->\n<!-- end predicted -->')
    monkeypatch.setattr('sys.argv', ['report', str(document)])
    report.main()
    text = document.read_text()
    assert '| foot |' in text and 'RTX 3090' in text and '| chest |' in text and text.count('\n') == 5


# ---- the page and the command ----------------------------------------------------------------------------------------


def test_page():
    outcomes = {'sm_80': Outcome(5, ['test_a.py: test_b'], Counter({'no OptiX': 2}))}
    spills = Kernel('drjit_0123456789abcdef', 'test_a.py', 80, 99, 200, 16)
    dr_jit_kernel = Kernel('gemm_f32_64_tn', 'test_a.py', 80, 99, 128, 16)
    assert spills.fails and not dr_jit_kernel.fails
    text = page(outcomes, [spills, dr_jit_kernel, Kernel('drjit_f', 'test_a.py', 80, 9, error='why')])
    assert '| sm_80 | 5 | 2 | 1 |' in text and '| no OptiX | 2 |' in text and '- sm_80: test_a.py: test_b' in text
    assert "| sm_80, Dr.Jit's own matrix products | 1 | 128 | 128 | 0 | 1 | 0 |" in text
    assert (
        '| sm_80 | 2 | 200 | 200 | 1 | 1 | 1 |' in text
        and '`0123456789ab` | `test_a.py`' in text
        and 'sm_80: why' in text
    )


def test_the_share_is_of_tests_that_exist():
    assert set(SHARE) < set(all_files(TESTS))


STAND_IN = """#!/bin/sh
# Runs a command, with a kernel that its driver would have compiled.
[ -z "$MODULE" ] || printf '%s' "$MODULE" > "$CUDA_ON_CPU_DUMP/twice.ptx"
exec "$@"
"""
OPTION = 'def pytest_addoption(parser):\n    parser.addoption("--all", action="store_true")\n'
PASSES = 'def test_once():\n    import pathlib\n    pathlib.Path("ran.txt").open("a").write("x")\n'


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A checkout of three test files, and a program that runs them."""
    tests, stand_in = tmp_path / 'tests', tmp_path / 'stand_in'
    (tests / 'part').mkdir(parents=True)
    (tmp_path / 'pytest.ini').write_text('[pytest]')
    (tests / 'conftest.py').write_text(OPTION)
    (tests / 'part/test_a.py').write_text(PASSES)
    (tests / 'test_b.py').write_text(PASSES + 'def test_more():\n    import pytest\n    pytest.skip("no room")\n')
    (tests / 'test_c.py').write_text('def test_fails():\n    assert 0\n')
    stand_in.write_text(STAND_IN)
    stand_in.chmod(0o755)
    monkeypatch.setenv('MODULE', MODULE)
    return stand_in, tests


def test_a_check_goes_on_where_it_was_stopped(ptxas, checkout, tmp_path):
    """A stored file is not run again; one that is cut off, or has failed, is. A kernel that several files compile counts once."""
    stand_in, tests = checkout
    names, cells, lines = all_files(tests), CellFiles(tmp_path / 'cells', 'outcome', 'kernels', 'code'), []
    assert names == ['part/test_a.py', 'test_b.py', 'test_c.py']
    first = run_tests(stand_in, tests, names, sm=75, cells=cells, report=lines.append)
    assert run_tests(stand_in, tests, names, sm=75, cells=cells, report=lines.append) == first
    outcome, kernels = first
    assert outcome.passed == 2 and outcome.skipped == {'no room': 1} and len(outcome.failed) == 1
    assert [kernel.name for kernel in kernels] == ['twice'] and kernels[0].spilled == 0
    assert (tmp_path / 'ran.txt').read_text() == 'xx'
    assert [line.split(';')[0] for line in lines[:3]] == [line.split(';')[0] for line in lines[3:]]
    cells.path('sm_75', 'test_b.py').write_text('{"outcome"')
    assert run_tests(stand_in, tests, names, sm=75, cells=cells, report=lines.append)[0] == outcome
    assert (tmp_path / 'ran.txt').read_text() == 'xxx'
    (tests / 'test_c.py').write_text(PASSES)
    outcome, _ = run_tests(stand_in, tests, names, sm=75, cells=cells, report=lines.append)
    assert (outcome.passed, outcome.failed) == (3, [])
    assert (tmp_path / 'ran.txt').read_text() == 'xxxxxx'  # of other code, all are run again


def test_files_without_kernels_run_once(ptxas, checkout, tmp_path, monkeypatch):
    stand_in, tests = checkout
    for folder, module, text in ('some', MODULE, 'xx'), ('none', '', 'xxx'):
        monkeypatch.setenv('MODULE', module)
        cells = CellFiles(tmp_path / folder, 'outcome', 'kernels', 'code')
        first, second = (
            run_tests(stand_in, tests, ['test_b.py'], sm=sm, cells=cells, report=str)[0] for sm in (75, 80)
        )
        assert first == second and first.passed == 1 and (tmp_path / 'ran.txt').read_text() == text


@pytest.mark.parametrize('args', [(), ('--stand-in', 'no-such-program'), ('--stand-in', 'true', '--tests', 'nowhere')])
def test_bad_input(args):
    code, out, err = run(CHECK, *args)
    assert code == 2 and err.startswith('error: ') and err.count('\n') == 1 and not out
