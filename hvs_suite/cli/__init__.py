"""The ``hvs`` command: one file a subcommand, each a typed dataclass with ``run()``."""
