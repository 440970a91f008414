"""The modules and formats that can be read, and the parser of each."""

from __future__ import annotations

from enum import Enum

from companion.uwb.dwm1001_shell import Dwm1001Shell
from companion.uwb.dwm1001_tlv import Dwm1001Tlv
from companion.uwb.fira_uci import FiraUci
from companion.uwb.linktrack import LinkTrack
from companion.uwb.measured import LosRule, Parser
from companion.uwb.qorvo_cli import QorvoCli
from companion.uwb.records import Csv, JsonLines


class Family(Enum):
    """The modules and formats that can be read."""

    QORVO_CLI = "qorvo-cli"
    FIRA_UCI = "fira-uci"
    DWM1001_SHELL = "dwm1001-shell"
    DWM1001_TLV = "dwm1001-tlv"
    LINKTRACK = "linktrack"
    JSON_LINES = "jsonl"
    CSV = "csv"


def open_parser(family: Family, los: LosRule = LosRule.UNKNOWN) -> Parser:
    """A fresh parser. Raises ValueError where the family tells nothing that the rule could be applied to."""
    if family is Family.FIRA_UCI:
        return FiraUci(los)
    if family is Family.LINKTRACK:
        return LinkTrack(los)
    if los is not LosRule.UNKNOWN:
        raise ValueError(f"{los.value}: {family.value} tells nothing of the signal's path")
    return _PLAIN[family]()


_PLAIN: dict[Family, type[QorvoCli] | type[Dwm1001Shell] | type[Dwm1001Tlv] | type[JsonLines] | type[Csv]] = {
    Family.QORVO_CLI: QorvoCli,
    Family.DWM1001_SHELL: Dwm1001Shell,
    Family.DWM1001_TLV: Dwm1001Tlv,
    Family.JSON_LINES: JsonLines,
    Family.CSV: Csv,
}
