"""Damaged and hostile files for every reader: a value, or one InputError of one line; never a crash, a hang or a traceback.

- `corpus`: small good files, made here
- `mutations`: what is done to them
- `readers`: who reads them, and what a value must be
- `child`: reads case after case in a process of its own, under a limit of memory
- `pool`: children that are replaced when they die; what each case came to
- `page`: the table of the documentation
"""
