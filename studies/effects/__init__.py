"""What modelling an effect of real projections is worth: `experiments.measure` finds it, `report.write` writes it down.

numbers = write({'psf': measure('psf')}, Path('out/effects'), figures=Path('out/effects'))
"""
