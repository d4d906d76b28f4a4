"""The command line reference, made from the commands themselves: ``{command-line}`` lists all of them."""

from __future__ import annotations

from typing import Any

from click import Command, Context
from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx


class CommandLine(Directive):
    """A section for every command: what it does, how it is called, its arguments and options."""

    def run(self) -> list[nodes.Node]:
        from omtwarp.commands import function_of
        from omtwarp.commands._cli import SUMMARIES, program
        from omtwarp.commands._command import as_command

        context = program.make_context("omtwarp", [], resilient_parsing=True)
        return [self.section(name, as_command(function_of(name)), context) for name in SUMMARIES]

    def section(self, name: str, command: Command, parent: Context) -> nodes.section:
        context = command.make_context(name, [], parent=parent, resilient_parsing=True)
        title = f"omtwarp {name}"
        section = nodes.section(ids=[nodes.make_id(title)], names=[nodes.fully_normalize_name(title)])
        section += nodes.title(title, title)
        self.state.document.note_implicit_target(section, section)
        first, *more = [" ".join(part.split()) for part in (command.help or "").partition("\f")[0].split("\n\n")]
        section += nodes.paragraph(first, first)
        usage = " ".join(["omtwarp", name, *command.collect_usage_pieces(context)])
        section += nodes.literal_block(usage, usage, language="text")
        section += [nodes.paragraph(text, text) for text in more]
        if command.epilog:
            section += nodes.literal_block(command.epilog, command.epilog, language="console")
        records = [parameter.get_help_record(context) for parameter in command.get_params(context)]
        section += self.table([record for record in records if record is not None])
        return section

    @staticmethod
    def table(rows: list[tuple[str, str]]) -> nodes.definition_list:
        listing = nodes.definition_list(classes=["options"])
        for names, words in rows:
            item = nodes.definition_list_item()
            term = nodes.term()
            term += nodes.literal(names, names)
            definition = nodes.definition()
            text = " ".join(str(words).split())
            definition += nodes.paragraph(text, text)
            item += [term, definition]
            listing += item
        return listing


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("command-line", CommandLine)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
