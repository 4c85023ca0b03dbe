//! CAN drivers of others on the emulated chip: each property is shown by the driver of embassy-stm32 and by bxcan.
//!
//! The programs are those of `lab/emulator/foreign/`.

#[path = "../../foreign/src/command.rs"]
#[allow(dead_code, reason = "the programs use the rest")]
mod command;
mod errors;
mod filters;
mod modes;
mod programs;
mod rates;
mod receive;
mod rig;
mod transmit;

/// Defines a test of each property with each driver.
macro_rules! shown_by {
    ($($driver:ident $variant:ident),*: $properties:tt) => {$(
        mod $driver {
            use crate::rig::Driver::$variant as DRIVER;

            shown_by!(@ $properties);
        }
    )*};
    (@ { $($module:ident: $($property:ident),*;)* }) => {$($(
        #[test]
        #[ignore = "builds embassy-stm32, about 80 s of CPU time"]
        fn $property() {
            crate::$module::$property(DRIVER);
        }
    )*)*};
}

shown_by! { embassy Embassy, bxcan Bxcan: {
    rates: frames_go_both_ways_at_each_bit_rate_that_a_running_controller_gets,
        frames_of_each_kind_and_length_go_both_ways,
        a_node_joins_the_bus_only_when_it_is_quiet;
    programs: its_log_is_read_and_its_led_blinks_every_millisecond;
    modes: loopback_receives_its_own_frames_without_another_node,
        loopback_shows_its_frames_on_the_bus_and_ignores_those_of_others,
        a_silent_node_receives_and_does_not_acknowledge,
        silent_loopback_is_a_self_test_apart_from_the_bus,
        a_sleeping_node_neither_receives_nor_acknowledges,
        the_entry_to_sleep_mode_interrupts,
        sleep_mode_begins_when_the_frame_under_way_has_ended,
        a_node_that_its_program_wakes_up_joins_the_bus_again,
        a_frame_on_the_bus_wakes_up_a_node_that_is_set_to;
    filters: without_a_filter_nothing_is_received_but_all_is_acknowledged,
        masks_of_32_and_of_16_bits_sort_into_either_fifo,
        a_mask_of_32_bits_covers_extended_identifiers,
        a_list_of_16_bits_has_four_identifiers_for_either_fifo,
        a_list_of_32_bits_has_two_identifiers_of_either_kind,
        a_list_tells_remote_frames_from_data_frames,
        of_several_filters_the_wider_then_the_list_then_the_lower_number_takes_the_frame,
        filters_can_change_while_the_bus_runs,
        the_last_bank_works_like_the_first;
    transmit: mailboxes_go_by_identifier_then_standard_then_data,
        three_frames_leave_without_a_gap,
        an_identifier_that_waits_is_refused_a_second_time,
        a_fourth_frame_takes_the_place_of_the_least_urgent,
        a_frame_that_waits_can_be_aborted_and_an_empty_mailbox_cannot,
        a_frame_under_way_is_sent_in_spite_of_an_abort,
        the_end_of_a_transmission_interrupts,
        a_frame_that_loses_the_arbitration_is_sent_afterwards,
        one_shot_gives_up_after_a_lost_arbitration,
        one_shot_sends_once_whether_or_not_somebody_acknowledges;
    receive: a_fifo_keeps_three_frames_in_their_order_and_a_fourth_replaces_the_newest,
        a_full_fifo_leaves_the_other_one_room,
        a_burst_of_fifty_frames_arrives_without_loss,
        a_frame_interrupts_on_the_line_of_its_fifo;
    errors: a_node_alone_becomes_error_passive_and_repeats_until_somebody_acknowledges,
        bus_off_ends_after_128_times_11_recessive_bits_and_spares_the_mailbox,
        bus_off_lasts_as_long_as_the_bus_is_dominant,
        a_frame_with_an_error_is_repeated_and_received_once,
        the_receive_error_counter_rises_with_each_bad_frame,
        a_transmission_with_an_error_is_repeated_at_once;
} }

// FDCAN neither sleeps nor tells remote frames by its filters; its driver does not wait for the bus, aborts nothing and
// refuses no identifier.
shown_by! { fdcan Fdcan: {
    rates: frames_go_both_ways_at_each_bit_rate_that_a_running_controller_gets,
        frames_of_each_kind_and_length_go_both_ways;
    programs: its_log_is_read_and_its_led_blinks_every_millisecond;
    modes: loopback_receives_its_own_frames_without_another_node,
        loopback_shows_its_frames_on_the_bus_and_ignores_those_of_others,
        a_silent_node_receives_and_does_not_acknowledge,
        silent_loopback_is_a_self_test_apart_from_the_bus;
    filters: without_a_filter_nothing_is_received_but_all_is_acknowledged,
        masks_of_32_and_of_16_bits_sort_into_either_fifo,
        a_mask_of_32_bits_covers_extended_identifiers,
        a_list_of_16_bits_has_four_identifiers_for_either_fifo,
        a_list_of_32_bits_has_two_identifiers_of_either_kind,
        filters_can_change_while_the_bus_runs;
    transmit: mailboxes_go_by_identifier_then_standard_then_data,
        three_frames_leave_without_a_gap,
        a_full_queue_gives_up_a_more_urgent_frame_for_a_less_urgent_one,
        the_end_of_a_transmission_interrupts,
        a_frame_that_loses_the_arbitration_is_sent_afterwards,
        one_shot_gives_up_after_a_lost_arbitration,
        one_shot_sends_once_whether_or_not_somebody_acknowledges;
    receive: a_full_fifo_of_fdcan_keeps_the_first_three_frames,
        a_burst_of_fifty_frames_arrives_without_loss;
    errors: a_node_alone_becomes_error_passive_and_repeats_until_somebody_acknowledges,
        bus_off_ends_after_128_times_11_recessive_bits_and_spares_the_mailbox,
        bus_off_lasts_as_long_as_the_bus_is_dominant,
        a_frame_with_an_error_is_repeated_and_received_once,
        the_receive_error_counter_rises_with_each_bad_frame,
        a_transmission_with_an_error_is_repeated_at_once;
} }
