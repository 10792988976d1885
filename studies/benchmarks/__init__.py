"""Times beside those of a kernel written by hand (`limit.cpp`), of Mitsuba's tree, and of other packages."""
