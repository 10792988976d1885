"""The gain from modelling an effect of real projections, measured by `experiments.measure`, reported by `report.write`.

numbers = write({'psf': measure('psf')}, Path('out/effects'), figures=Path('out/effects'))
"""
