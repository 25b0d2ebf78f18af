"""Completion of `libero` in a shell: its commands, and the options that their help names."""

import contextlib
import io

from libero_cli.main import ALL, bind
from libero_env.cli import ending
from libero_env.cli.options import options_in

_SCRIPT = """\
[ -z "$ZSH_VERSION" ] || {{ autoload -U +X bashcompinit && bashcompinit; }}
_libero() {{
  local words="" current="${{COMP_WORDS[COMP_CWORD]}}"
  case "${{COMP_WORDS[*]:1:$((COMP_CWORD - 1))}}" in
{cases}
  esac
  COMPREPLY=($(compgen -W "$words" -- "$current"))
}}
complete -o default -F _libero libero
"""


def completion() -> None:
    """Print a script that completes commands and options in bash and zsh; where there are none, files."""
    topics: dict[str, list[str]] = {}
    for name in ALL:
        topic, _, action = name.partition(" ")
        topics.setdefault(topic, []).append(action)
    cases = [f'    "") words="{" ".join(topics)}" ;;']
    cases += [f'    "{topic}") words="{" ".join(names)}" ;;' for topic, names in topics.items() if names[0]]
    for name in ALL:
        options = " ".join([*_options(name), *ending.EVERYWHERE])
        cases.append(f'    "{name}"|"{name} "*) [[ "$current" != -* ]] || words="{options}" ;;')
    print(_SCRIPT.format(cases="\n".join(cases)), end="")


def _options(name: str) -> list[str]:
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
        bind(name, ["--help"])()
    return options_in(text.getvalue())
