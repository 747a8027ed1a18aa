"""Generated code: do not edit; `python -m companion.link.dialect` writes it from `rsbn.xml`."""
