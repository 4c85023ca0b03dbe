//! Dates and times of day.

use std::time::Duration;

/// A time since 1970 as a date and a time of day.
pub fn date_and_time(since_1970: Duration) -> String {
    let (days, seconds) = (since_1970.as_secs() / 86_400, since_1970.as_secs() % 86_400);
    // Years that begin in March have their leap day at the end; 400 of them have 146,097 days.
    let day = days + 719_468;
    let (era, of_era) = (day / 146_097, day % 146_097);
    let year = (of_era - of_era / 1_460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year + year / 4 - year / 100);
    let month = (5 * of_year + 2) / 153;
    let of_month = of_year - (153 * month + 2) / 5 + 1;
    let (month, next) = if month < 10 { (month + 3, 0) } else { (month - 9, 1) };
    let (hours, minutes) = (seconds / 3600, seconds / 60 % 60);
    format!("{:04}-{month:02}-{of_month:02} {hours:02}:{minutes:02} UTC", era * 400 + year + next)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_has_its_date() {
        let text = |seconds| date_and_time(Duration::from_secs(seconds));
        assert_eq!(text(0), "1970-01-01 00:00 UTC");
        assert_eq!(text(951_827_696), "2000-02-29 12:34 UTC");
        assert_eq!(text(1_740_787_199), "2025-02-28 23:59 UTC");
        assert_eq!(text(4_107_542_400), "2100-03-01 00:00 UTC");
    }
}
