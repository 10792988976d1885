"""`python -m lingo_mi` is the console command `lingo-mi`."""

from lingo_mi.cli import main

if __name__ == '__main__':
    main()
