"""``hvs ship``: a trained policy with its model card, as a folder or on the Hugging Face Hub."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ship:
    """Share a trained policy: write its model card, and copy it or push it to the Hub.

    Takes a folder that hvs pretrain or hvs finetune made, and shares only its weights, its settings
    and how the training went. The Hub's token is taken from HF_TOKEN or an earlier login; it is
    neither printed nor stored.

    Attributes:
        policy: Checkpoint folder; without --to-folder the card goes into it as README.md.
        to_folder: Folder to copy to, such as policies/pretrained/align-thesis; the card goes there.
        to_hub: Repository to push to, user/name.
        private: Make the repository private.
        result: Result file of hvs evaluate to put into the card; give it several times for several.
        command: The command that made the policy, for the card.
    """

    policy: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")]
    to_folder: Path | None = None
    to_hub: str | None = None
    private: bool = False
    result: tuple[Path, ...] = ()
    command: str = ""

    def run(self) -> None:
        """Describe it and hand it over."""
        from hvs_suite.datasets.publication import check_repository
        from hvs_suite.eval.scoring import result_file
        from hvs_suite.policies.checkpoints import card, files, hub

        if self.to_hub is not None:
            check_repository(self.to_hub)
        results = [result_file.load(path).model_dump(mode="json") for path in self.result]
        folder = self.policy
        if self.to_folder is not None:
            card.ship(self.policy, self.to_folder)
            folder = self.to_folder
        card.write_card(folder, results, self.command)
        print(f"wrote {folder / card.CARD}")
        if self.to_hub is not None:
            names = (card.CARD, *files.FILES, *card.TRAINING_FILES)
            hub.push(folder, self.to_hub, names, private=self.private)
            print(f"pushed to {self.to_hub}")
