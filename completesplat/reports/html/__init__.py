"""One page of HTML that needs nothing else: tables, figures, and samples that turn under the mouse."""
