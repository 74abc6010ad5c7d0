"""Report of a day or a week of a home for a carer: a page and a picture."""
