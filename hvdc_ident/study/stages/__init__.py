"""The stages, one file each; see `hvdc_ident.study.stage` for what a file supplies."""
