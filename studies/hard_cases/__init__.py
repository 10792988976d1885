"""Hard cases: clouds, views, grids and scans where float32 is pressed, with the error that each may show.

`cases.all_cases` lists them, `measuring.measure` compares one with float64 or tells how it was refused or warned of, and
`table.markdown` makes a page of the results.

    results = [(case, measure(case)) for case in all_cases()]
    page = markdown(results)
"""
