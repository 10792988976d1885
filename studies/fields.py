"""A neural field beside clouds of Gaussians, on the same scans: quality against CPU time.

    python -m lingo_mi.studies.fields --objects foot --views 5 10 25 --iterations 1000
    python -m lingo_mi.studies.fields --methods naf -D rate_features=1e-2,1e-3 -D rate_network=3e-3,3e-4 -D epsilon=1e-10
    python -m lingo_mi.studies.fields --objects foot chest engine aneurism --scale paper --iterations 75000

Objects, scans and the recipes' number of points are those of `lingo-mi tables`. A field takes --iterations steps, fast its own
number, the others 5000. Views are measured on a few of the 50 held out, since a field takes a second of CPU for some hundred
thousand samples. Each fit is stored when it is done, with the seconds of CPU that its steps took; the same command goes on.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from lingo_mi import metrics
from lingo_mi.file_access import replacing, write_text
from lingo_mi.fitting.initial import initial_cloud
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.recipes import settings_of
from lingo_mi.fitting.settings import Settings
from lingo_mi.progress import Progress
from lingo_mi.runtime import use_variant
from lingo_mi.scan import Dataset
from lingo_mi.scene.simulate import choose_views
from lingo_mi.studies.markdown import table
from lingo_mi.studies.provenance import provenance, write_provenance
from lingo_mi.studies.tables.cells import SCALES, Cells

STEPS = 5000  # of recipes that name no number of their own
COLUMNS = [
    ('object', lambda r: r['object']),
    ('views', lambda r: str(r['views'])),
    ('method', lambda r: r['method']),
    ('steps', lambda r: f'{r["iterations"]:,}'),
    ('CPU seconds', lambda r: f'{r["cpu_seconds"]:,.0f}'),
    ('new views, PSNR', lambda r: f'{r["psnr_2d_r2"]:.2f}'),
    ('SSIM', lambda r: f'{r["ssim_2d_r2"]:.4f}'),
    ('volume, PSNR', lambda r: f'{r["psnr_3d_r2"]:.2f}'),
    ('SSIM', lambda r: f'{r["ssim_3d_r2"]:.4f}'),
]


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('--objects', nargs='+', default=['foot'])
    p.add_argument('--views', nargs='+', type=int, default=[5, 10, 25])
    p.add_argument('--methods', nargs='+', default=['fast', 'lingo', 'r2', 'naf'])
    p.add_argument('--iterations', type=int, default=1000, help='of a field')
    p.add_argument(
        '-D',
        dest='define',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help='a setting of the field (any number of these)',
    )
    p.add_argument('--scale', choices=SCALES, default='small')
    p.add_argument('--test', type=int, default=5, help='held-out views to measure')
    p.add_argument('--out', type=Path, default=Path('out/fields'))
    p.add_argument('--variant', help='of Mitsuba')
    args = p.parse_args()
    use_variant(args.variant)
    cells = Cells(args.out, SCALES[args.scale])
    args.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in args.objects:
        for views in args.views:
            for method in args.methods:
                settings = settings_of(method, n_points=cells.scale.n_points)
                label = method
                if not settings.cloud:
                    settings = settings.changed(
                        iterations=args.iterations, **dict(d.split('=', 1) for d in args.define)
                    )
                    label = ' '.join([method, *args.define])
                elif settings.decay_steps:
                    settings = settings.changed(iterations=STEPS)
                of = label.replace(':', '_').replace(' ', '_')
                path = args.out / f'{name}_{args.scale}_{views}_{of}_{settings.iterations}_{args.test}.json'
                if not path.exists():
                    dataset = choose_views(cells.dataset(name), views)
                    found = dict(object=name, views=views, method=label, scale=args.scale, test=args.test)
                    found |= measured(dataset, settings, args.test, f'{name}, {views} views, {label}')
                    with replacing(path) as temporary:
                        temporary.write_text(json.dumps(found | dict(provenance=provenance()), indent=1) + '\n')
                rows.append(json.loads(path.read_text(encoding='utf-8')))
                write_text(args.out / 'fields.md', table(COLUMNS, rows) + '\n')
                write_provenance(args.out / 'fields.md')
    print(table(COLUMNS, rows))


def measured(dataset: Dataset, settings: Settings, test: int, label: str) -> dict:
    """Fit a scan and measure the result; `history` has the volume's PSNR over CPU time.

    test   how many held-out views to render
    """
    history, spent = [], 0.0
    truth, held = dataset.volume, dataset.test
    assert truth is not None and held is not None  # as every object of the tables
    held = held.subset(np.arange(test) * len(held) // test)
    last = time.process_time()

    def look(model, state):
        nonlocal spent, last
        spent += time.process_time() - last
        found = dict(psnr_3d=metrics.psnr_3d_r2(model.volume(state), truth))
        history.append(dict(cpu_seconds=spent, **found))
        last = time.process_time()
        return found

    with Progress(label, settings.iterations) as bar:
        fitted = run(dataset.train, settings, initial_cloud(dataset.train, settings), 0, look, bar.update)
    spent += time.process_time() - last
    volume, rendered = fitted.volume(), fitted.render(held.geometry)
    assert volume is not None  # as of every method but those of opacities
    return dict(
        iterations=settings.iterations,
        cpu_seconds=spent,
        seconds=fitted.seconds,
        psnr_2d_r2=metrics.psnr_2d_r2(rendered, held.projections),
        ssim_2d_r2=metrics.ssim_2d_r2(rendered, held.projections),
        psnr_3d_r2=metrics.psnr_3d_r2(volume, truth),
        ssim_3d_r2=metrics.ssim_3d_r2(volume, truth),
        history=history,
        settings=settings.flat(),
    )


if __name__ == '__main__':
    main()
