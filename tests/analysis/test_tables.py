"""The table of a run's parameters."""

from mosa.analysis.tables import parameter_table


def test_both_stages_have_their_error_where_the_truth_is_known():
    figures = {"id_prior/E": 1.1e5, "id/E": 0.95e5, "id_prior/E_relative_error": 0.1, "id/E_relative_error": 0.05,
               "id_prior/E_ratio": 1.1, "id_prior/contact_offset_m": 0.01}  # fmt: skip
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in parameter_table(figures).splitlines()]
    assert rows[0] == ["parameter", "prior", "joint", "error of prior", "error of joint"]
    assert rows[2:] == [["E", "1.1e+05", "95000", "10.0%", "5.0%"], ["contact_offset_m", "0.01", "nan", "", ""]]
