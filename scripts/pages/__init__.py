"""Pages of the site that are made from the code: `hooks` adds them when mkdocs builds the site."""
