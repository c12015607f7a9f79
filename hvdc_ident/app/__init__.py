"""The workbench: a page in the browser on this machine's own server, where a model answers while a slider moves.

    from hvdc_ident.app import serve
    serve("my-study/study.toml")          # prints an address; ends with Ctrl-C

The page computes nothing of its own: every number comes from the public verbs of the package. A tab of the page is a file in
`tabs/` with `TAB = Tab(...)`; no tab is registered anywhere else. The framework is NiceGUI: it sends
single messages over one socket to elements that keep their state, where Streamlit runs a script anew at every change, and it
needs no network. Curves are drawn on canvas by uPlot, whose files come with the package.
"""

from hvdc_ident.app.server import serve

__all__ = ["serve"]
