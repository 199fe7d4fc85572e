"""Published sets are what tables 2 and 3 print, in the convention named; a user's file is checked as closely."""

from pathlib import Path

import pytest

from dvc.errors import InputError
from fe import Material, MaterialSet, NeoHooke, Ogden, Yeoh, material_set, published_names, read_material_sets
from fe.published import doubts
from fe.variation import with_stiffness

# Initial shear modulus (kPa) and Poisson's ratio by hand from the printed numbers.
PRINTED = {
    ("trebbi", "fat"): (3.4 * 6.2 / 2, 0.4999),
    ("trebbi", "skin"): (2 * 265.0, 0.4999),
    ("trebbi", "muscle"): (2 * 5.0, 0.4999),
    ("akrami", "all"): (385.9, 0.49),
    ("erdemir", "all"): (16.45 * 6.82 / 2, 0.49),
    ("erdemir-as-published", "all"): (16.45, 0.49),
    ("friedman", "skin"): (324.7, 0.495),
    ("friedman", "fat"): (0.290, 0.495),
    ("luboz", "skin"): (66.89, 0.495),
    ("luboz", "fat"): (10.07, 0.49),
    ("luboz", "muscle"): (20.07, 0.495),
    ("spears", "skin"): (640.0 * 6.8 / 2, 0.49),
    ("spears", "fat"): (0.290 * 8.8 / 2, 0.495),
    ("spears-as-published", "skin"): (640.0, 0.49),
    ("spears-as-published", "fat"): (0.290, 0.495),
    ("zwam", "skin"): (50.0 * 2.3 / 2, 0.49),
    ("zwam", "fat"): (16.45 * 6.82 / 2, 0.49),
    ("zwam", "muscle"): (20.07, 0.49),
}


def test_a_stiffness_in_another_unit_is_told() -> None:
    """Ten times the range of the published material sets, of the tissue or of what stands for it."""
    fat, skin = Ogden.of(0.0105, 6.2), NeoHooke.of(0.1)
    usual = MaterialSet("mine", "", "", {"fat": fat, "skin": skin, "foam": NeoHooke.of(1e3)})
    assert usual.for_regions(["fat", "skin", "foam"])[1] == ()
    (note,) = MaterialSet("mine", "", "", {"fat": Ogden.of(10.5, 6.2)}).for_regions(["fat"])[1]
    assert note.startswith("mine: fat has a shear modulus of 1.05e+04 kPa")
    assert note.endswith("in kPa, entered as MPa?")
    (note,) = MaterialSet("mine", "", "", {"all": NeoHooke.of(5e-6)}).for_regions(["skin"])[1]
    assert "as soft as in any published set" in note
    assert note.endswith("in MPa, entered as kPa?")
    for name in published_names():
        assert not [note for note in material_set(name).for_regions(["fat", "muscle", "skin"])[1] if "modulus" in note]

    for name in published_names():  # each published modulus of a tissue, typed in the other unit
        for tissue, law in material_set(name).materials.items():
            for times, unit in ((1e3, "in kPa, entered as MPa?"), (1e-3, "in MPa, entered as kPa?")):
                if tissue != "all":
                    typed = MaterialSet("mine", "", "", {tissue: NeoHooke.of(times * law.shear_modulus_mpa)})
                    (note,) = typed.for_regions([tissue])[1]
                    assert note.endswith(unit), note
    notes = MaterialSet("mine", "", "", {"fat": NeoHooke.of(0.29)}).for_regions(["fat", "muscle"])[1]
    assert notes[0] == "mine has no material for muscle; that of fat is used."
    assert "fat has a shear modulus of 290 kPa" in notes[1]
    akrami = dict.fromkeys(("fat", "skin"), material_set("akrami").materials["all"])
    assert doubts("", akrami) == doubts("", with_stiffness(akrami, "fat", 0.1)) == []  # an input that is varied
    for modulus_mpa in (0.002, 2.0):  # of one law for all tissues
        assert MaterialSet("mine", "", "", {"all": NeoHooke.of(modulus_mpa)}).for_regions(["fat", "skin"])[1] == ()

    (note,) = MaterialSet("mine", "", "", {"foam": NeoHooke.of(1e-8)}).for_regions(["foam"])[1]
    assert note.startswith("mine: foam has a shear modulus of 1e-05 kPa, which is over 1000 times as soft")


@pytest.mark.parametrize(
    ("law", "range_told"),
    [
        (Yeoh.of(0.265, -0.1), "equibiaxial stretches from 0.83 to 1.22"),
        (Ogden.of([0.02, -0.01], [2.0, 10.0]), "equibiaxial stretches from 0.95 to 1.09"),
        (Yeoh.of(0.005, -0.01, 0.05), ""),
        (Yeoh.of(0.005, -0.0004), ""),
    ],
)
def test_a_law_whose_stress_falls_at_strains_of_use_is_told(law: Material, range_told: str) -> None:
    notes = MaterialSet("mine", "", "", {"foam": law}).for_regions(["foam"])[1]
    assert len(notes) == bool(range_told)
    assert all(f"foam is stable (rising stress) only at {range_told}" in note for note in notes)


def test_every_published_law_has_the_printed_modulus() -> None:
    found = {(name, tissue): law for name in published_names() for tissue, law in material_set(name).materials.items()}
    assert found.keys() == PRINTED.keys()
    for key, (modulus_kpa, nu) in PRINTED.items():
        assert 1000 * found[key].shear_modulus_mpa == pytest.approx(modulus_kpa, rel=1e-12), key
        assert found[key].nu == nu, key


@pytest.mark.parametrize("name", published_names())
def test_published_laws_are_stable_and_say_where_they_are_from(name: str) -> None:
    published = material_set(name)
    assert published.title
    assert "able" in published.source
    for law in published.materials.values():
        for mode in ("uniaxial", "equibiaxial", "pure shear"):
            low, high = law.stable_range(mode)
            assert low <= 0.5
            assert high >= 2.0


def test_a_region_without_a_law_takes_its_neighbours_and_says_so() -> None:
    laws, notes = material_set("luboz").for_regions(["skin", "fat", "muscle", "tendon"])
    assert laws["tendon"] is laws["muscle"]
    assert notes == ("luboz has no material for tendon; that of muscle is used.",)
    laws, notes = material_set("spears").for_regions(["skin", "fat", "muscle", "tendon"])
    assert laws["tendon"] is laws["muscle"] is laws["fat"]
    assert len(notes) == 2
    laws, notes = material_set("akrami").for_regions(["skin", "tendon"])
    assert laws["skin"] is laws["tendon"]
    assert notes == ()


def test_a_set_without_fat_refuses_a_region_it_cannot_serve(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('[mine.skin]\nlaw = "neo-Hooke"\nmu_kpa = 100\nnu = 0.49\n')
    with pytest.raises(InputError, match="no material for the region 'tendon' \\(nor for muscle or fat"):
        material_set(file).for_regions(["skin", "tendon"])
    with pytest.raises(
        InputError, match=r"no material for the region 'ligament'; it has skin, fat, muscle\. Write your own"
    ):
        material_set("luboz").for_regions(["skin", "ligament"])


def test_regions_are_called_alike_in_any_case() -> None:
    laws, notes = material_set("luboz").for_regions(["SKIN", "Fat"])
    assert laws["SKIN"] is material_set("luboz").materials["skin"]
    assert notes == ()


def test_own_sets_in_all_forms(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(
        '[one]\ntitle = "Ours"\n[one.fat]\nlaw = "Ogden"\nconvention = "febio"\nc_kpa = [20, 4.0]\nm = [6, -2]\n'
        'nu = 0.499\n[two.skin]\nlaw = "Yeoh"\nc10_mpa = 0.2\nc20_mpa = 1\nc30_kpa = 30\nnu = 0.4999\n'
    )
    sets = read_material_sets(file)
    assert sets["one"].title == "Ours"
    assert sets["one"].materials["fat"].shear_modulus_mpa == pytest.approx(0.012)
    assert sets["two"].materials["skin"].vector.tolist() == pytest.approx([0.2, 1.0, 0.03, 0.0])
    with pytest.raises(InputError, match="contains 2 material sets"):
        material_set(file)


GOOD = 'law = "neo-Hooke"\nmu_kpa = 100\nnu = 0.49\n'


def test_models_have_the_names_that_fits_give_them(tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text(
        '[a.fat]\nlaw = "Isihara"\nc10_kpa = 8\nc20_kpa = 2\nnu = 0.49\n'
        '[a.skin]\nlaw = "Yeoh"\nc10_kpa = 8\nc20_kpa = 2\nnu = 0.49\n'
        '[a.muscle]\nlaw = "Hencky"\nmu_kpa = 30\nnu = 0.49\n'
        '[a.tendon]\nlaw = "linear elastic"\nmu_kpa = 30\nnu = 0.49\n'
    )
    models = material_set(tmp_path / "own.toml").materials
    for one, other in (("fat", "skin"), ("muscle", "tendon")):
        assert models[one].vector.tolist() == models[other].vector.tolist()
        assert models[one].law == models[other].law
    (tmp_path / "own.toml").write_text('[a.fat]\nlaw = "Isihara"\nc10_kpa = 8\nc20_kpa = 2\nc30_kpa = 1\nnu = 0.49\n')
    with pytest.raises(InputError, match="Isihara has no parameter 'c30_kpa'"):
        material_set(tmp_path / "own.toml")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[a.fat\n", "not a TOML file"),
        ("", "no material set"),
        ("mu = 1\n", "'mu' does not belong to a set"),
        ('[a]\ntitle = "x"\n', "has no tissue"),
        ("[a]\nfat = 3\n", "a tissue must be a table"),
        (
            "[a.fat]\nmu_kpa = 1\n",
            "law must be one of neo-Hooke, Isihara, Yeoh, Hencky, linear elastic, Ogden; got None",
        ),
        ('[a.fat]\nlaw = "Ogden"\nmu_kpa = 1\nalpha = 2\nnu = 0.4\n', "needs convention = 'ansys' or 'abaqus' or"),
        ("[a.fat]\nconvention = 'ansys'\n" + GOOD, "'convention' is only for Ogden models"),
        ("[a.fat]\n" + GOOD.replace("mu_kpa", "mu"), "'mu' needs its unit: mu_kpa or mu_mpa"),
        ("[a.fat]\n" + GOOD.replace("mu_kpa", "mew_kpa"), "no parameter 'mew_kpa'; its parameters are mu_kpa"),
        ("[a.fat]\n" + GOOD.replace("nu =", "nu_kpa ="), "no parameter 'nu_kpa'"),
        ("[a.fat]\n" + GOOD + "mu_mpa = 0.1\n", "'mu' is given twice"),
        ("[a.fat]\n" + GOOD.replace("nu = 0.49\n", ""), "needs nu"),
        ("[a.fat]\n" + GOOD.replace("100", "'soft'"), "mu_kpa must be a number; got 'soft'"),
        ("[a.fat]\n" + GOOD.replace("100", "[1, 2]"), "mu_kpa must be a number; got"),
        ("[a.fat]\n" + GOOD.replace("100", "true"), "mu_kpa must be a number; got True"),
        ("[a.fat]\n" + GOOD.replace("0.49", "0.5"), "a.fat: neo-Hooke.*Poisson's ratio"),
    ],
)
def test_a_file_that_cannot_be_used_says_where_and_why(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(text)
    with pytest.raises(InputError, match=said) as refused:
        material_set(file)
    assert "mine.toml" in str(refused.value)


def test_names_that_are_not_there() -> None:
    with pytest.raises(InputError, match="did you mean 'trebbi'"):
        material_set("trebi")
    with pytest.raises(InputError, match=r"nowhere\.toml: the material sets cannot be read"):
        material_set("nowhere.toml")
