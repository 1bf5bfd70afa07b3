"""Events of pixels that wait, held, until their row is read."""

from __future__ import annotations

from enum import IntEnum

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS})

END = 2**62
"""A time that never comes [ps]."""

NEVER = -END
"""A time that always was [ps]."""


class PixelColumn(IntEnum):
    """What is known of a pixel, [ps] but for the last column, whose bytes `arbitrate` names."""

    LAST = 0
    """Its last event."""

    FREED = 1
    """When it was let go."""

    INTERVAL = 2
    """From the event before to the last one where both had one polarity, else 0."""


class PixelByte(IntEnum):
    """Bytes of a pixel that are set from outside."""

    OTHER = 31
    """1 where its events are not sent."""


class ArbiterNumber(IntEnum):
    """Places of single numbers that an arbiter remembers, in the order of `arbitrate`."""

    FREE = 0
    """When the bus is free [ps]."""

    FIRST_LINE = 1
    QUEUED = 2
    HEAPED = 3
    LAST_OTHER = 4
    GHOSTS = 5
    OTHERS = 6

    SENT = 7
    """Events that the last call wrote."""

    HELD = 8
    """Pixels of the recording that wait or will ask late."""

    WHEEL_WORDS = 9
    NODES = 10
    FREE_NODE = 11
    NOW = 12
    WHEELED = 13


SLOTS = 4096
"""Of the wheel of late requests: a bit for each in 64 words, a bit for each word in one."""

NODES = 1 << 14
"""Late requests that the wheel holds; more wait in the heap."""


def slot_shift(per_line: int, per_event: int) -> int:
    """Return how many bits of a time [ps] lie within a slot of the wheel.

    While the bus is full about one request comes late in the time for which it reads one event, so slots of
    about that length hold one or none.
    """
    return min(max((per_line + per_event).bit_length() - 1, 10), 40)


RECENT = 64
"""Requests of others whose lines are remembered, a power of 2."""


@wp.func_native(
    """
    const long long END = 1ll << 62;
    const int AHEAD = 16;  // events whose pixels are on their way from memory
    typedef unsigned long long Bits;
    const long long LONGEST_GAP = 100000000ll;  // [ps] others' requests that stand for several spread over it
    // half a cache line for all that an event needs to know
    struct Pixel {
        long long last, freed, interval;  // [ps]
        unsigned char status;  // 1: asks late, 2: waits
        unsigned char last_polarity, polarity, label;
        unsigned short turn;  // of the late requests
        unsigned char spare, other;
    };
    static_assert(sizeof(Pixel) == 32, "a pixel is four numbers of 64 bits");
    Pixel* const pixels = (Pixel*)known.data;
    const int mask = (1 << shift) - 1;
    Bits* const bits = (Bits*)waiting.data;
    Bits* const line_bits = (Bits*)line_words.data;
    long long* const since = line_since.data;
    int* const many_in = line_count.data;
    int* const queue = line_queue.data;
    long long* const heap_at = heap_due.data;
    long long* const heap_who = heap_what.data;
    long long* const number = numbers.data;
    const int lines = line_count.shape[0];
    const int words = waiting.shape[1];
    int few = 0;  // 2**few words of a line share one of the 64 bits that say which are not empty
    while ((words - 1) >> few > 63) ++few;
    const int room = heap_due.shape[0];
    long long free = number[0];
    int first = (int)number[1], queued = (int)number[2], heaped = (int)number[3], wheeled = (int)number[13];
    long long last_other = number[4], ghosts = number[5], other_requests = number[6];
    long long held_pixels = number[8];
    int out = 0;

    const unsigned short* const line_of = by_columns ? x.data : y.data;
    const unsigned short* const across_of = by_columns ? y.data : x.data;
    unsigned short* const out_line = by_columns ? out_x.data : out_y.data;
    unsigned short* const out_across = by_columns ? out_y.data : out_x.data;
    auto place_of = [&](int k) { return (line_of[k] << shift) + across_of[k]; };
    auto time_of = [&](int k) { return 1000 * (long long)rint(1e9 * arrival.data[k]); };
    auto send = [&](int pixel, long long nanosecond) {
        out_time.data[out] = 1e-9 * (double)nanosecond;
        out_line[out] = (unsigned short)(pixel >> shift);
        out_across[out] = (unsigned short)(pixel & mask);
        out_polarity.data[out] = pixels[pixel].polarity;
        out_label.data[out++] = (signed char)pixels[pixel].label;
    };
    long long soonest = 0;  // when anybody else may ask
    auto into_line = [&](int line, long long t) {
        if (many_in[line]++ == 0) {
            since[line] = t;
            const int last = first + queued++;
            queue[last < lines ? last : last - lines] = line;
        }
    };
    auto sooner = [&](long long t, long long who, int at) {
        return t < heap_at[at] || (t == heap_at[at] && who < heap_who[at]);
    };
    auto push_heap = [&](long long t, long long who) {
        int at = heaped++;
        while (at > 0 && sooner(t, who, (at - 1) / 2)) {
            heap_at[at] = heap_at[(at - 1) / 2];
            heap_who[at] = heap_who[(at - 1) / 2];
            at = (at - 1) / 2;
        }
        heap_at[at] = t;
        heap_who[at] = who;
    };
    auto pop_heap = [&]() {
        const long long t = heap_at[--heaped];
        const long long who = heap_who[heaped];
        int at = 0;
        for (;;) {
            int below = 2 * at + 1;
            if (below >= heaped) break;
            if (below + 1 < heaped && sooner(heap_at[below + 1], heap_who[below + 1], below)) ++below;
            if (sooner(t, who, below)) break;
            heap_at[at] = heap_at[below];
            heap_who[at] = heap_who[below];
            at = below;
        }
        heap_at[at] = t;
        heap_who[at] = who;
    };
    // Late requests are in a wheel of slots of time, or in the heap where they are due later than one turn of
    // the wheel or no node is left. Half of all events come late on a full bus, hundreds of them at once: the
    // soonest of a heap costs some ten comparisons that no processor guesses, that of a wheel one or two.
    long long* const node_at = node_due.data;
    long long* const node_who = node_what.data;
    int* const node_next = node_after.data;
    int* const slot = wheel.data;  // its first node, 0 for none
    Bits* const slot_bits = (Bits*)wheel_bits.data;
    const int slots = wheel.shape[0], nodes = node_after.shape[0];
    Bits filled = (Bits)number[9];  // words of slot_bits that are not empty
    int fresh = (int)number[10], free_node = (int)number[11];  // nodes used so far; the first free one
    long long now = number[12];  // all in the wheel is due within a turn from here
    long long wheel_at = END, wheel_who = 0;  // the soonest in the wheel
    int wheel_slot = 0;
    auto find_in_wheel = [&]() {
        wheel_at = END;
        if (filled == 0) return;
        const int here = (int)(now >> slot_shift) & (slots - 1);
        int word = here / 64;
        Bits left = slot_bits[word] & (~0ull << (here & 63));
        if (left == 0) {
            const Bits later = word < 63 ? filled & (~0ull << (word + 1)) : 0;
            word = __builtin_ctzll(later ? later : filled);
            left = slot_bits[word];
        }
        wheel_slot = 64 * word + __builtin_ctzll(left);
        int node = slot[wheel_slot];
        wheel_at = node_at[node];
        wheel_who = node_who[node];
        while ((node = node_next[node]) != 0) {
            if (node_at[node] < wheel_at || (node_at[node] == wheel_at && node_who[node] < wheel_who)) {
                wheel_at = node_at[node];
                wheel_who = node_who[node];
            }
        }
        if (wheel_who >= 0) __builtin_prefetch(pixels + (wheel_who & 0xffffffffll), 1);
    };
    auto push_late = [&](long long t, long long who) {
        const long long ahead = (t >> slot_shift) - (now >> slot_shift);
        if (ahead < 0 || ahead >= slots || (free_node == 0 && fresh + 1 >= nodes)) {
            push_heap(t, who);
            return;
        }
        int node = free_node;
        if (node != 0) free_node = node_next[node];
        else node = ++fresh;
        const int at = (int)(t >> slot_shift) & (slots - 1);
        node_at[node] = t;
        node_who[node] = who;
        node_next[node] = slot[at];
        slot[at] = node;
        slot_bits[at / 64] |= 1ull << (at & 63);
        filled |= 1ull << (at / 64);
        ++wheeled;
        if (t < wheel_at || (t == wheel_at && who < wheel_who)) {
            wheel_at = t;
            wheel_who = who;
            wheel_slot = at;
        }
    };
    auto pop_wheel = [&]() {
        int* link = slot + wheel_slot;
        while (node_at[*link] != wheel_at || node_who[*link] != wheel_who) link = node_next + *link;
        const int node = *link;
        *link = node_next[node];
        node_next[node] = free_node;
        free_node = node;
        if (slot[wheel_slot] == 0) {
            const int word = wheel_slot / 64;
            slot_bits[word] &= ~(1ull << (wheel_slot & 63));
            if (slot_bits[word] == 0) filled &= ~(1ull << word);
        }
        --wheeled;
        find_in_wheel();
    };
    auto request = [&](int pixel, long long t) {
        Pixel& mine = pixels[pixel];
        const int line = pixel >> shift;
        if (mine.other) {
            // the golden ratio, so that any run of numbers is spread evenly: whole, right in the mean
            const long long many =
                (weight.data[mine.polarity] + ((other_requests++ * 2654435769ll) & 0xffffffffll)) >> 32;
            if (many == 0) {
                mine.status = 0;
                return;
            }
            // what it stands for beside itself asks in lines that others asked in lately, soon after it
            long long gap = t - last_other;
            if (gap > LONGEST_GAP) gap = LONGEST_GAP;
            last_other = t;
            recent.data[other_requests % 64] = line;
            const long long known = other_requests < 64 ? other_requests : 64;
            for (long long k = 1; k < many; ++k) {
                const unsigned int drawn = (unsigned int)(++ghosts * 2654435769ll) >> 8;
                const int there = recent.data[(other_requests - drawn % known) & 63];
                if (heaped + wheeled < room) push_late(t + gap * k / many, -1 - there);
                else into_line(there, t);
            }
        }
        if (queued == 0 && free <= t && t < soonest) {
            // most often nobody else asks: it is read at once
            const long long whole = t / 1000 - (t % 1000 < 0);
            free = t + per_line + per_event;
            mine.status = 0;
            mine.freed = free;
            if (mine.other) return;
            --held_pixels;
            send(pixel, whole);
            return;
        }
        mine.status = 2;
        const int word = (pixel & mask) / 64;
        bits[(size_t)line * words + word] |= 1ull << (pixel & mask & 63);
        line_bits[line] |= 1ull << (word >> few);
        into_line(line, t);
    };
    // time from an event until the light has gone on by the share held / interval of a threshold, on the
    // parabola through the last three events [ps]; END where it turns before. Events that no parabola goes
    // through, as of noise, are taken to go on as they did.
    auto until_share = [&](long long held, long long interval, long long one_before) -> long long {
        const double second = (double)interval;
        if (1000 * held < interval) return 0;  // not worth a place in the heap
        if (one_before <= 0 || second > 2.414 * (double)one_before) return held;
        const double share = (double)held / second;
        const double first = (double)one_before / second;  // in units of the last interval
        const double bend = (1.0 / first - 1.0) / (0.5 * (first + 1.0));
        const double lost = 0.5 * bend;
        const double speed = 1.0 - lost;
        const double square = speed * speed;
        const double needs = 2.0 * bend;
        const double all = needs * share;
        if (speed <= 0.0 || square < all) return END;
        const double root = sqrt(square - all);
        const double ratio = 2.0 * share / (speed + root);
        return (long long)(ratio * second);
    };
    auto arrive = [&](int pixel, long long t, unsigned char polarity, unsigned char label) {
        Pixel& mine = pixels[pixel];
        const long long before = mine.last;
        const bool goes_on = before > -END && mine.last_polarity == polarity;
        const long long interval = goes_on ? t - before : 0, one_before = mine.interval;
        mine.last = t;
        mine.interval = interval;
        mine.last_polarity = polarity;
        if (mine.status == 2 || t < mine.freed) return;  // held: it sees nothing
        if (mine.status == 1) {
            // the light has gone on beyond the next threshold, or turned back before it
            if (mine.polarity == polarity) {
                request(pixel, t);
            } else {
                mine.status = 0;
                held_pixels -= !mine.other;
            }
            return;
        }
        held_pixels += !mine.other;
        mine.polarity = polarity;
        mine.label = label;
        // let go a share of an interval after the event before, it asks that share of a threshold later
        const long long held = goes_on && mine.freed > before ? mine.freed - before : 0;
        const long long late = held > 0 ? until_share(held, interval, one_before) : 0;
        if (late == 0 || (late < END && heaped + wheeled >= room)) {
            request(pixel, t);
            return;
        }
        mine.status = 1;
        ++mine.turn;
        // where the light turns before, it asks only if it goes on beyond its next event after all
        if (late < END) push_late(t + late, pixel | (long long)mine.turn << 32);
    };

    find_in_wheel();
    int i = 0, j = 0;
    const int count = arrival.shape[0], others = other.shape[0];
    const bool has_label = label.shape[0] > 0;
    long long due_raw = count > 0 ? time_of(0) : END;
    for (;;) {
        // the soonest late request; one that was taken back leaves its place in wheel or heap
        bool from_heap;
        long long due_t, who;
        for (;;) {
            from_heap = heaped > 0 && !sooner(wheel_at, wheel_who, 0);
            due_t = from_heap ? heap_at[0] : wheel_at;
            who = from_heap ? heap_who[0] : wheel_who;
            if (due_t == END || who < 0) break;
            const Pixel& mine = pixels[who & 0xffffffffll];
            if (mine.status == 1 && mine.turn == (who >> 32)) break;
            if (from_heap) pop_heap();
            else pop_wheel();
        }
        const long long raw_t = due_raw;
        const long long other_t = j < others ? other.data[j] : END;
        const long long next = raw_t < other_t ? raw_t : other_t;
        const long long ask = due_t <= next ? due_t : next;
        if (queued > 0) {
            const int line = queue[first];
            const long long begin = free > since[line] ? free : since[line];
            // requests of that very moment are in it
            if (begin < ask) {
                if (begin >= until) break;
                const long long end = begin + per_line + (long long)many_in[line] * per_event;
                const long long whole = begin / 1000 - (begin % 1000 < 0);
                Bits some = line_bits[line];
                line_bits[line] = 0;
                int w = 0, ending = 0;  // words of one of its bits
                while (w < ending || some != 0) {
                    if (w == ending) {
                        w = __builtin_ctzll(some) << few;
                        ending = w + (1 << few) < words ? w + (1 << few) : words;
                        some &= some - 1;
                    }
                    Bits left = bits[(size_t)line * words + w];
                    bits[(size_t)line * words + w] = 0;
                    for (; left != 0; left &= left - 1) {
                        const int pixel = (line << shift) + 64 * w + __builtin_ctzll(left);
                        Pixel& mine = pixels[pixel];
                        mine.status = 0;
                        mine.freed = end;
                        if (mine.other) continue;
                        --held_pixels;
                        send(pixel, whole);
                    }
                    ++w;
                }
                many_in[line] = 0;
                if (++first == lines) first = 0;
                --queued;
                free = end;
                if (queued > 0 && line_bits[queue[first]] != 0) {
                    // it has waited long enough for its pixels to have left the caches
                    const int soon = queue[first], begins = __builtin_ctzll(line_bits[soon]) << few;
                    const Bits there = bits[(size_t)soon * words + begins];
                    const Pixel* const its = pixels + (soon << shift) + 64 * begins;
                    if (there != 0) __builtin_prefetch(its + __builtin_ctzll(there), 1);
                }
                continue;
            }
        }
        if (ask == END) break;
        if (due_t <= next) {
            if (next == END && due_t >= until) break;
            if (due_t > now) now = due_t;
            if (from_heap) pop_heap();
            else pop_wheel();
            soonest = next < until ? next : until;
            if (heaped > 0 && heap_at[0] < soonest) soonest = heap_at[0];
            if (wheel_at < soonest) soonest = wheel_at;
            if (who < 0) into_line((int)(-1 - who), due_t);
            else request((int)(who & 0xffffffffll), due_t);
            continue;
        }
        if (next > now) now = next;
        const bool mine_first = raw_t <= other_t;
        const int after_i = i + mine_first, after_j = j + !mine_first;
        const long long after_raw = mine_first ? (after_i < count ? time_of(after_i) : END) : raw_t;
        const long long after_other = after_j < others ? other.data[after_j] : END;
        soonest = after_raw < after_other ? after_raw : after_other;
        if (due_t < soonest) soonest = due_t;
        if (until < soonest) soonest = until;
        if (mine_first) {
            if (i + AHEAD < count) __builtin_prefetch(pixels + place_of(i + AHEAD), 1);
            arrive(place_of(i), raw_t, polarity.data[i], has_label ? (unsigned char)label.data[i] : 0);
            ++i;
            due_raw = after_raw;
        } else {
            arrive(other_place.data[j], other_t, other_polarity.data[j], 0);
            ++j;
        }
    }
    number[0] = free;
    number[1] = first;
    number[2] = queued;
    number[3] = heaped;
    number[4] = last_other;
    number[5] = ghosts;
    number[6] = other_requests;
    number[7] = out;
    number[8] = held_pixels;
    number[9] = (long long)filled;
    number[10] = fresh;
    number[11] = free_node;
    number[12] = now;
    number[13] = wheeled;
"""
)
def arbitrate(
    arrival: wp.array[wp.float64],
    x: wp.array[wp.uint16],
    y: wp.array[wp.uint16],
    polarity: wp.array[wp.uint8],
    label: wp.array[wp.int8],
    other: wp.array[wp.int64],
    other_place: wp.array[int],
    other_polarity: wp.array[wp.uint8],
    weight: wp.array[wp.int64],
    until: wp.int64,
    shift: int,
    by_columns: bool,
    per_line: wp.int64,
    per_event: wp.int64,
    slot_shift: int,
    known: wp.array2d[wp.int64],
    waiting: wp.array2d[wp.int64],
    line_words: wp.array[wp.int64],
    line_since: wp.array[wp.int64],
    line_count: wp.array[int],
    line_queue: wp.array[int],
    heap_due: wp.array[wp.int64],
    heap_what: wp.array[wp.int64],
    wheel: wp.array[int],
    wheel_bits: wp.array[wp.int64],
    node_due: wp.array[wp.int64],
    node_what: wp.array[wp.int64],
    node_after: wp.array[int],
    recent: wp.array[int],
    numbers: wp.array[wp.int64],
    out_time: wp.array[wp.float64],
    out_x: wp.array[wp.uint16],
    out_y: wp.array[wp.uint16],
    out_polarity: wp.array[wp.uint8],
    out_label: wp.array[wp.int8],
):
    """Do what `send_by_lines` does; arguments have the shape and unit that it says."""
    ...


@wp.kernel(enable_backward=False)
def send_by_lines(
    # in
    arrival: wp.array[wp.float64],  # (N,) [s], taken as whole nanoseconds, not decreasing
    x: wp.array[wp.uint16],  # (N,) column
    y: wp.array[wp.uint16],  # (N,) row
    polarity: wp.array[wp.uint8],  # (N,) 1 for ON
    label: wp.array[wp.int8],  # (N,), or (0,) where there are none
    other: wp.array[wp.int64],  # (M,) [ps], not decreasing: events that take room and time and are not sent
    other_place: wp.array[int],  # (M,) of those, line * 2**shift + place in the line
    other_polarity: wp.array[wp.uint8],  # (M,) of those
    weight: wp.array[wp.int64],  # (2,) how many events one of those stands for, times ONE, by polarity
    until: wp.int64,  # nothing is read from here on while later requests may come [ps]
    shift: int,  # a line has room for 2**shift pixels
    by_columns: bool,  # whether lines are columns
    per_line: wp.int64,  # time to take a line [ps]
    per_event: wp.int64,  # time to send one event of it [ps]
    slot_shift: int,  # a slot of the wheel is 2**slot_shift ps
    # in and out
    known: wp.array2d[wp.int64],  # (lines * 2**shift, 4) `PixelColumn`
    waiting: wp.array2d[wp.int64],  # (lines, words) bit of each pixel that waits
    line_words: wp.array[wp.int64],  # (lines,) which of 64 equal parts of a line have bits
    line_since: wp.array[wp.int64],  # (lines,) first request of a line [ps]
    line_count: wp.array[int],  # (lines,) requests of a line
    line_queue: wp.array[int],  # (lines,) ring of lines with requests, in order of their first
    heap_due: wp.array[wp.int64],  # (K,) [ps] a heap: the children of k are 2 k + 1 and 2 k + 2
    heap_what: wp.array[wp.int64],  # (K,) turn * 2**32 + pixel, or -1 - line for a request of no pixel
    wheel: wp.array[int],  # (SLOTS,) the first node of each slot, 0 for none
    wheel_bits: wp.array[wp.int64],  # (SLOTS / 64,) bit of each slot that has nodes
    node_due: wp.array[wp.int64],  # (NODES,) as heap_due
    node_what: wp.array[wp.int64],  # (NODES,) as heap_what
    node_after: wp.array[int],  # (NODES,) the next node of the slot, 0 for none
    recent: wp.array[int],  # (RECENT,) lines of the last others' requests
    numbers: wp.array[wp.int64],  # (14,) `ArbiterNumber`
    # out
    out_time: wp.array[wp.float64],  # (L,) when the line was taken [s], in whole nanoseconds
    out_x: wp.array[wp.uint16],  # (L,)
    out_y: wp.array[wp.uint16],  # (L,)
    out_polarity: wp.array[wp.uint8],  # (L,)
    out_label: wp.array[wp.int8],  # (L,)
):
    """Read lines in the order of their first requests, on one thread.

    Who waits depends on all that was read before, so this is no scan. Times are whole picoseconds of 64 bits.
    """
    arbitrate(
        arrival, x, y, polarity, label, other, other_place, other_polarity, weight, until, shift, by_columns,
        per_line, per_event, slot_shift, known, waiting, line_words, line_since, line_count, line_queue,
        heap_due, heap_what, wheel, wheel_bits, node_due, node_what, node_after, recent, numbers, out_time,
        out_x, out_y, out_polarity, out_label,
    )  # fmt: skip
