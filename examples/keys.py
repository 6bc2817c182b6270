"""Print the reference of all keys of a survey file and of a plan.

The page is written by: python examples/keys.py > examples/keys.md
"""

from rangesfm.planning.plan_file import plan_tables
from rangesfm.survey.settings import KEYS, SURVEY_TABLES

HEAD = """# Keys of a survey file

Every key is optional. `rangesfm run` takes each also as the flag beside it, which overrides the file. Paths are
relative to the survey file, those of flags to the working directory. The [glossary](glossary.md) explains the words.
This page is written by `python examples/keys.py > examples/keys.md`.
"""


def cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def main() -> None:
    print(HEAD)
    for table, model in SURVEY_TABLES.items():
        print(f"## [{table}]\n\n{model.__doc__}\n\n| key | flag | value | meaning |\n|---|---|---|---|")
        for key in KEYS:
            if key.table == table:
                flag = f"`--{key.flag}`" + (f", `--no_{key.flag}`" if key.type is bool else "")
                print(f"| `{key.name}` | {flag} | {cell(key.expected)} | {cell(key.meaning)} |")
        print()
    print(
        "# Keys of a plan\n\nThese are for the file that `rangesfm plan` reads; [how to plan a survey](planning.md).\n"
    )
    for table, options in plan_tables().items():
        print(f"## [{table}] of a plan\n\n{options.__doc__}\n\n| key | value | meaning |\n|---|---|---|")
        for key in options.keys().values():
            print(f"| `{key.name}` | {cell(key.expected)} | {cell(key.meaning)} |")
        print()
    print("This is the end of the tour. [Back to its start](../README.md).")


if __name__ == "__main__":
    main()
