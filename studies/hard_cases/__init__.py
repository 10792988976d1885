"""Hard cases: clouds, views, grids and scans at the limits of float32, each with its permitted error.

`cases.all_cases` lists them. `measuring.measure` compares a case with float64, or reports how it was refused or which warning it
caused. `table.markdown` makes a page of the results.

    results = [(case, measure(case)) for case in all_cases()]
    page = markdown(results)
"""
