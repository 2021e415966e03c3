"""The paper's tables and figures, each by one command: train what is missing, measure, draw.

    python benchmarks/paper.py exact_rewards --budget cpu  five trainings a row, then its table and figure
    python benchmarks/paper.py all --budget smoke
    python benchmarks/paper.py objects --output docs/results

Every row writes `report.json` as soon as a seed of it is done, so that an interrupted command goes on there. A row that
was measured with a larger budget is kept. Trainings are in `runs/paper`, and are resumed as well. The parts are in the
folder of the same name, which Python finds before this file.
"""

from paper.command import main

from dexsim.core import cli

if __name__ == "__main__":
    cli.run(main)
