"""The page of a run: what it tells, that it asks for nothing else, that a browser shows it."""

from dataclasses import replace
from html.parser import HTMLParser
import json
import re
import shutil
import subprocess

from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    DeblurResult,
    EnergyStep,
    Motion,
    Outcome,
    RgbdFrame,
)
from depth_deblur_ros.notes import note_of, Run, shot_of, SHOTS, signed_twists, spread_evenly
from depth_deblur_ros.page import run_page
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

BROWSERS = (
    'chromium-headless-shell',
    'chromium',
    'chromium-browser',
    'google-chrome',
    'google-chrome-stable',
)
CAMERA = CameraIntrinsics(700.0, 700.0, 399.5, 299.5, 800, 600)
RNG = np.random.default_rng(0)
P = np.array([0.01, -0.02, 0.005, 0.001, 0.002, -0.003])
STEPS = tuple(
    EnergyStep(0, f'{end} turn 1', {'variation': 2.0, 'motion': -0.5})
    for end in ('before', 'after')
)


def result_of(number, outcome=Outcome.SOLVED, sign=False, energies=()):
    image = RNG.random((600, 800, 3), np.float32)
    p = P * (-1) ** number if outcome is Outcome.SOLVED else 0 * P
    return DeblurResult(
        image=image,
        depth=np.linspace(1, 3, 480_000, dtype=np.float32).reshape(600, 800),
        motion=Motion.from_vector(p, 1e-8 * np.eye(6)),
        outcome=outcome,
        sign_resolved=sign,
        quality=0.5,
        blur_px=12.0,
        seconds=0.25,
        energies=energies,
    )


def run_of(outcomes, **more):
    """Give a run of frames at 30 Hz, the first of them with energies."""
    notes, shots = [], []
    for k, outcome in enumerate(outcomes):
        result = result_of(k, outcome, energies=STEPS if k == 0 else ())
        frame = RgbdFrame(1 - result.image, result.depth, CAMERA, 0.02, 10**18 + 33_333_333 * k)
        notes.append(note_of(frame.stamp_ns, 0.02, result))
        shots.append(shot_of(frame, result))
    return Run('a <bag> & more', notes, shots, **more)


class Elements(HTMLParser):
    """Gather the tags with their attributes, and the text."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.words, self.open = [], [], []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ('meta', 'img', 'input', 'link', 'br'):
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    def all(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope='module')
def page():
    outcomes = [Outcome.SOLVED, Outcome.SHARP, Outcome.FAILED, Outcome.SOLVED]
    truth = {10**18: -P / 0.02, 10**18 + 33_333_333 * 3: -P / 0.02}
    run = run_of(outcomes, truth=truth, lost={'no depth within <slop>': 7})
    notes = [*run.notes[:2], replace(run.notes[2], reason='depth & image differ'), run.notes[3]]
    return run_page(replace(run, notes=notes))


def test_every_element_is_closed_and_every_link_leads_somewhere(page):
    found = Elements(page)
    assert found.open == []
    ids = [a['id'] for _, a in found.tags if 'id' in a]
    assert len(set(ids)) == len(ids)
    links = [a['href'] for a in found.all('a')]
    assert links == ['#frame-0', '#frame-1', '#frame-2', '#frame-3']
    assert {link[1:] for link in links} <= set(ids)


def test_the_page_asks_for_nothing_else(page):
    found = Elements(page)
    sources = [a[k] for _, a in found.tags for k in ('src', 'href', 'data', 'action') if k in a]
    assert all(s.startswith(('data:image/webp;base64,', '#')) for s in sources)
    assert not found.all('link') and 'url(' not in page and '@import' not in page
    policy = next(a['content'] for a in found.all('meta') if 'http-equiv' in a)
    assert policy.startswith("default-src 'none'")
    assert set(re.findall(r'https?://[^"\s]+', page)) <= {'http://www.w3.org/2000/svg'}


def test_each_frame_shows_four_pictures_that_say_what_they_are(page):
    pictures = Elements(page).all('img')
    assert len(pictures) == 4 * 4
    assert all(p['alt'] and (p['width'], p['height']) == ('640', '480') for p in pictures)


def test_counts_reasons_and_energies_are_told(page):
    text = ' '.join(' '.join(Elements(page).words).split())
    assert 'a <bag> & more' in text
    assert 'frames 4' in text and 'sharp 1' in text and 'solved 2' in text and 'lost 7' in text
    assert 'failed 1 depth & image differ' in text
    assert 'lost 7 no depth within <slop>' in text
    assert 'sign of the truth' not in text and 'that of the truth' in text
    assert 'Energy over each turn' in text
    assert 'θ = (10.0 ± 0.1, -20.0 ± 0.1, 5.0 ± 0.1) mrad' in text


def test_a_single_picture_has_no_time_to_draw_over():
    page = run_page(run_of([Outcome.SHARP]))
    ids = [a['id'] for _, a in Elements(page).tags if 'id' in a]
    assert ids == ['frames', 'frame-0', 'energy', 'losses']


def test_the_energy_of_each_size_is_drawn():
    run = run_of([Outcome.SOLVED] * 2)
    assert all([e.level for e in shot.gains] == [0, 0, 1, 1] for shot in run.shots)
    page = run_page(replace(run, notes=[replace(note, energies=()) for note in run.notes]))
    text = ' '.join(Elements(page).words)
    assert 'At half the size' in text and 'At full size' in text and 'image as taken' in text


def test_what_was_left_as_it_was_is_not_called_sharp():
    run = run_of([Outcome.SOLVED])
    same = {**run.shots[0].pictures, 'sharp': run.shots[0].pictures['blurred']}
    left = replace(run, shots=[replace(run.shots[0], pictures=same)])
    captions = [
        re.findall(r'<figcaption><span>blurred</span><span>(\w+)', run_page(r))
        for r in (run, left)
    ]
    assert captions == [['sharp'], ['unchanged']]


def test_a_run_of_no_frames_is_a_page_too():
    assert Elements(run_page(Run('nothing', [], []))).open == []


def test_pages_are_bounded_whatever_the_pictures_hold():
    (shot,) = run_of([Outcome.SOLVED]).shots  # noise, which nothing can compress
    assert SHOTS * sum(map(len, shot.pictures.values())) < 8_000_000


@given(st.integers(0, 500), st.integers(1, 20))
def test_frames_are_chosen_evenly_with_the_ends_among_them(count, most):
    chosen = spread_evenly(count, most)
    assert len(chosen) == min(count, most)
    assert chosen == sorted(set(chosen))
    if count and most > 1:
        assert chosen[0] == 0 and chosen[-1] == count - 1
        steps = np.diff(chosen)
        assert not steps.size or steps.max() - steps.min() <= 1


def notes_of(outcomes, sign=False):
    return [note_of(k, 0.02, result_of(k, o, sign)) for k, o in enumerate(outcomes)]


def test_an_open_sign_is_drawn_like_the_frame_before_or_the_truth():
    notes = notes_of([Outcome.SOLVED, Outcome.FAILED, Outcome.SOLVED])
    notes[2] = replace(notes[2], p=-P)
    alone = signed_twists(Run('', notes, []))
    np.testing.assert_allclose(alone[0], -P / 0.02)
    assert np.isnan(alone[1]).all()
    np.testing.assert_allclose(alone[2], alone[0])
    turned = signed_twists(Run('', notes, [], truth={0: P / 0.02}))
    np.testing.assert_allclose(turned[[0, 2]], [P / 0.02, P / 0.02])


def test_a_known_sign_is_never_turned():
    notes = notes_of([Outcome.SOLVED] * 3, sign=True)
    twists = signed_twists(Run('', notes, []))
    np.testing.assert_allclose(twists[1], -twists[0])


PROBE = """<script>
const trouble = [];
addEventListener('error', e => trouble.push(e.message || 'a resource'), true);
document.addEventListener('securitypolicyviolation', e => trouble.push(e.violatedDirective));
addEventListener('load', () => {
  const wipe = document.querySelector('.wipe'), slider = wipe.querySelector('input');
  const clip = () => getComputedStyle(wipe.querySelector('.sharp')).clipPath;
  const before = clip();
  slider.value = 20;
  slider.dispatchEvent(new Event('input'));
  const images = [...document.images];
  const svgs = [...document.querySelectorAll('svg')];
  document.title = JSON.stringify({
    trouble, before, after: clip(),
    pictures: images.filter(i => i.complete && i.naturalWidth > 0).length,
    charts: svgs.filter(s => s.getBoundingClientRect().height > 100).length,
    overflow: document.documentElement.scrollWidth - innerWidth,
    ink: getComputedStyle(document.body).color,
    paper: getComputedStyle(document.body).backgroundColor,
  });
});
</script>"""


@pytest.mark.parametrize('width', [1280, 500])
def test_a_browser_shows_the_page_and_moves_the_slider(page, tmp_path, width):
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip(f'no headless browser: none of {", ".join(BROWSERS)}')
    file = tmp_path / 'page.html'
    file.write_text(page.replace('<head>', '<head>' + PROBE))
    command = [browser, '--headless', '--no-sandbox', '--disable-gpu', '--hide-scrollbars']
    command += [f'--user-data-dir={tmp_path}/profile', f'--window-size={width},900', '--dump-dom']
    done = subprocess.run([*command, file.as_uri()], capture_output=True, text=True, timeout=120)
    title = re.search('<title>(.*?)</title>', done.stdout, re.S)
    assert title, done.stderr
    seen = json.loads(title[1].replace('&amp;', '&').replace('&gt;', '>').replace('&lt;', '<'))
    assert seen['trouble'] == []
    assert (seen['pictures'], seen['charts']) == (16, 11)
    assert seen['before'].endswith('50%)') and seen['after'].endswith('20%)')
    assert seen['overflow'] <= 0
    assert seen['ink'] != seen['paper']
