import lab.commands  # noqa: F401  (before numpy is loaded: threads of the linear algebra, as on the command line)
