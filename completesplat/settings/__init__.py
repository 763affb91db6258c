"""Options in `conf/`, the checks of their values, and the arguments and help of commands."""
