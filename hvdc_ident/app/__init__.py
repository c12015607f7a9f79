"""The workbench: a page in the browser on this machine's own server, where a model answers while a slider moves.

    from hvdc_ident.app import serve
    serve("my-study/study.toml")          # prints an address; ends with Ctrl-C

The page computes nothing of its own: every number comes from the public verbs of the package. A tab of the page is a file in
`tabs/` with `TAB = Tab(...)`; no tab is registered anywhere else. The framework is NiceGUI: it sends single messages over one
socket to elements that keep their state, where Streamlit runs a script anew, and it brings a canvas plotter (ECharts) of its
own, so that nothing is loaded from a network.
"""

from hvdc_ident.app.server import serve

__all__ = ["serve"]
