"""Tools for people who design tasks and objects; nothing else in the package imports them."""
