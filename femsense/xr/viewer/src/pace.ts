// How many poses a second a source sends.

const OVER_MS = 2000; // it is counted
export const COUNT_MS = 100; // between two counts

/** Counts by the numbers of the poses: a page that is busy drawing takes poses late, fewer of them, and in bursts. */
export class Pace {
  private newest = { at: -Infinity, seq: 0 }; // when it came [ms of the page], and its number
  private readonly counts: { at: number; seq: number }[] = [];

  /** Takes note of a pose. */
  take(at: number, seq: number): void {
    if (seq < this.newest.seq) this.counts.length = 0; // the source counts anew
    this.newest = { at, seq };
  }

  /** Counts; to be called every COUNT_MS. */
  count(now: number): void {
    if (this.newest.at > (this.counts[this.counts.length - 1]?.at ?? -Infinity)) this.counts.push(this.newest);
    while (this.counts.length && this.counts[0]!.at < now - OVER_MS) this.counts.shift();
  }

  /** Returns the middle of the slopes between counts (Theil and Sen), so that one that was late moves nothing; null as long as too few are there. */
  hz(): number | null {
    const { counts } = this;
    const span = counts.length ? counts[counts.length - 1]!.at - counts[0]!.at : 0;
    if (span < OVER_MS / 4) return null;
    const slopes = counts.flatMap((a, i) => counts.slice(i + 1).map((b) => (1000 * (b.seq - a.seq)) / (b.at - a.at)));
    return slopes.sort((a, b) => a - b)[slopes.length >> 1]!;
  }
}
