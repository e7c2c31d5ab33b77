"""``hvs tasks``: the named tasks and what each of them fixes."""

import dataclasses

from hvs_suite.cli import console


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tasks:
    """List the named tasks.

    Attributes:
        json: Print every parameter of every task as JSON.
    """

    json: bool = False

    def run(self) -> None:
        """Print the table or the JSON document."""
        import hvs_suite

        specs = hvs_suite.TASKS.values()
        if self.json:
            console.print_json(
                [dataclasses.asdict(v) | {"instruction": v.instruction()} for v in specs]
            )
            return
        console.print_table(
            ("task", "start", "target", "tolerance", "held", "steps", "EIH, ETH px", "varied"),
            [
                (
                    f"{spec.name}-v{spec.version}",
                    words.start,
                    words.target,
                    words.tolerance,
                    words.held or "-",
                    words.time,
                    f"{spec.eih_resolution}, {spec.eth_resolution}",
                    words.disturbances,
                )
                for spec, words in ((spec, spec.describe()) for spec in specs)
            ],
        )
