"""The report: drawn from a journal alone, as Markdown, as one page of HTML, as figures."""
