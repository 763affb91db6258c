"""Parts of a batch, and what happens when a GPU's memory is too small for them."""

from concurrent.futures import ThreadPoolExecutor
from itertools import chain

import pytest
import torch

from completesplat.diffusion.sampling import LARGEST_PART, PART, in_parts, one_thread_each, part_of


@pytest.mark.parametrize("threads", [0, 2])
@pytest.mark.parametrize(("most", "sizes"), [(None, [7]), (7, [7]), (3, [3, 3, 1]), (1, [1] * 7), (100, [7])])
def test_all_are_drawn_in_order(most, sizes, threads):
    items = list(range(7))
    parts = in_parts(lambda part: items[part], 7, most, threads)
    assert [len(part) for part in parts] == sizes
    assert list(chain(*parts)) == items


def test_two_threads_have_work_before_parts_become_larger_and_many_samples_give_work_to_more():
    sizes = {1: PART, PART: PART, 2 * PART: PART, 12: 6, 20: LARGEST_PART, 100: LARGEST_PART}
    assert {count: part_of(count) for count in sizes} == sizes


def test_calls_that_overlap_leave_torchs_number_of_threads_as_it_was(set_threads):
    denoiser = torch.nn.Linear(1, 1)
    set_threads(3)
    with one_thread_each(denoiser, torch.device("cpu")), ThreadPoolExecutor(1) as pool:
        inner = one_thread_each(denoiser, torch.device("cpu"))
        assert pool.submit(inner.__enter__).result() == 3
    pool_of_new_threads = ThreadPoolExecutor(1)
    pool_of_new_threads.submit(inner.__exit__, None, None, None).result()
    with ThreadPoolExecutor(1) as later:
        assert later.submit(torch.get_num_threads).result() == 3


def test_parts_that_do_not_fit_are_halved_until_they_do(caplog):
    asked = []
    room = 3

    def draw(part: slice) -> list[int]:
        items = list(range(11))[part]
        asked.append(len(items))
        if len(items) > room:
            raise torch.cuda.OutOfMemoryError
        return items

    assert list(chain(*in_parts(draw, 11))) == list(range(11))
    assert asked == [11, 6, 3, 3, 3, 2]
    assert [record.getMessage().split(" ")[0] for record in caplog.records] == ["11", "6"]
    room = 0
    with pytest.raises(torch.cuda.OutOfMemoryError):
        in_parts(draw, 4)


@pytest.mark.parametrize("mode", [torch.inference_mode, torch.no_grad, torch.enable_grad])
def test_threads_draw_in_the_mode_of_their_caller(mode):
    def modes(part: slice) -> tuple[object, ...]:
        return torch.is_inference_mode_enabled(), torch.is_grad_enabled(), torch.is_autocast_enabled("cpu")

    with mode(), torch.autocast("cpu", torch.bfloat16):
        assert set(in_parts(modes, 3, 1, threads=2)) == {modes(slice(0))}
