/* Stop a gigabrain robot when something comes near: C with zenoh-pico, as a node of rmw_zenoh.
 *
 *   cmake -S zenoh-pico -B build -DBUILD_EXAMPLES=OFF -DBUILD_TESTING=OFF -DBUILD_SHARED_LIBS=OFF \
 *         -DBATCH_UNICAST_SIZE=65535 -DFRAG_MAX_SIZE=4000000 && make -C build -j2
 *   cc -std=c11 -D_GNU_SOURCE -DZENOH_LINUX -I zenoh-pico/include -I build/include stop.c \
 *         build/lib/libzenohpico.a -lpthread -lrt -o stop
 *   ./stop tcp/127.0.0.1:7447 [METRES]
 *
 * It reads /scan, and calls /estop once a beam is shorter. The robot then stays stopped until you call
 * /release and /enable. It has no liveliness tokens, so `ros2 node list` does not show it. For
 * little-endian processors. Without the last two flags of cmake, zenoh-pico drops large messages.
 */
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>
#include <zenoh-pico.h>

/* ROS_DOMAIN_ID, name (with its namespace, if it has one), type, and hash of the type */
#define SCAN "0/scan/sensor_msgs::msg::dds_::LaserScan_/" \
    "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828"
#define ESTOP "0/estop/std_srvs::srv::dds_::SetBool_/" \
    "RIHS01_abe9e4bb6b41b40e6789712c00ec8871923e089af3f667a79992a428cff2da0a"

static float near_m = 0.3f;
static volatile bool is_near = false;
static volatile int exit_code = -1; /* until there is an answer */

static uint32_t u32(const uint8_t *at) {
    uint32_t value;
    memcpy(&value, at, sizeof value);
    return value;
}

/* Looks at sensor_msgs/LaserScan in CDR: 4 bytes, stamp, frame_id, 7 floats, then the ranges. */
static void look(const uint8_t *cdr, size_t size) {
    static int scans = 0;
    if (size < 16 || cdr[0] != 0 || cdr[1] != 1) return;
    size_t at = 16 + (size_t)u32(cdr + 12); /* behind frame_id */
    at = (at + 3) / 4 * 4;
    if (at + 32 > size) return;
    float range_min, range_max, nearest = 1e9f, range;
    memcpy(&range_min, cdr + at + 20, 4);
    memcpy(&range_max, cdr + at + 24, 4);
    uint32_t beams = u32(cdr + at + 28);
    if (beams > (size - at - 32) / 4) return;
    for (uint32_t i = 0; i < beams; i++) {
        memcpy(&range, cdr + at + 32 + 4 * (size_t)i, 4);
        /* infinite is free and nan is unknown: neither of them is near */
        if (range >= range_min && range <= range_max && range < nearest) nearest = range;
    }
    if (scans++ % 10 == 0) printf("%u beams, the nearest %.2f m\n", beams, (double)nearest);
    if (nearest < near_m) is_near = true;
}

static void on_scan(z_loaned_sample_t *sample, void *context) {
    (void)context;
    z_owned_slice_t payload;
    if (z_bytes_to_slice(z_sample_payload(sample), &payload) < 0) return;
    look(z_slice_data(z_loan(payload)), z_slice_len(z_loan(payload)));
    z_drop(z_move(payload));
}

/* Takes std_srvs/SetBool_Response in CDR: 4 bytes, success, 3 of padding, message. */
static void on_reply(z_loaned_reply_t *reply, void *context) {
    (void)context;
    z_owned_slice_t payload;
    if (!z_reply_is_ok(reply)) return;
    if (z_bytes_to_slice(z_sample_payload(z_reply_ok(reply)), &payload) < 0) return;
    const uint8_t *cdr = z_slice_data(z_loan(payload));
    size_t size = z_slice_len(z_loan(payload));
    if (size > 12 && u32(cdr + 8) <= size - 12) {
        printf("e-stop: %.*s\n", (int)u32(cdr + 8), (const char *)cdr + 12);
        exit_code = cdr[4] ? 0 : 1;
    }
    z_drop(z_move(payload));
}

/* Calls /estop with `data: true`. The attachment is that of each message and request of rmw_zenoh. */
static bool press(const z_loaned_session_t *session) {
    const uint8_t request[] = {0, 1, 0, 0, 1};
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    static int64_t sequence = 0;
    int64_t numbers[] = {++sequence, (int64_t)now.tv_sec * 1000000000 + now.tv_nsec};
    uint8_t attachment[33] = "";
    memcpy(attachment, numbers, 16);
    attachment[16] = 16; /* length of the sender's id: any that no other node has */
    snprintf((char *)attachment + 17, 16, "%d", (int)getpid());
    z_view_keyexpr_t key;
    z_view_keyexpr_from_str_unchecked(&key, ESTOP);
    z_owned_closure_reply_t closure;
    z_closure(&closure, on_reply, NULL, NULL);
    z_owned_bytes_t payload, attached;
    z_bytes_copy_from_buf(&payload, request, sizeof request);
    z_bytes_copy_from_buf(&attached, attachment, sizeof attachment);
    z_get_options_t options;
    z_get_options_default(&options);
    options.payload = z_move(payload);
    options.attachment = z_move(attached);
    options.target = Z_QUERY_TARGET_ALL_COMPLETE;
    options.timeout_ms = 1000;
    return z_get(session, z_loan(key), "", z_move(closure), &options) >= 0;
}

int main(int argc, char **argv) {
    if (argc < 2) return fprintf(stderr, "usage: stop ENDPOINT [METRES]\n"), 2;
    if (argc > 2) near_m = strtof(argv[2], NULL);
    setvbuf(stdout, NULL, _IOLBF, 0);
    z_owned_config_t config;
    z_config_default(&config);
    zp_config_insert(z_loan_mut(config), Z_CONFIG_MODE_KEY, "client");
    zp_config_insert(z_loan_mut(config), Z_CONFIG_CONNECT_KEY, argv[1]);
    z_owned_session_t session;
    if (z_open(&session, z_move(config), NULL) < 0) return fprintf(stderr, "no router\n"), 1;
    if (zp_start_read_task(z_loan_mut(session), NULL) < 0 ||
        zp_start_lease_task(z_loan_mut(session), NULL) < 0)
        return fprintf(stderr, "no threads\n"), 1;
    z_owned_closure_sample_t closure;
    z_closure(&closure, on_scan, NULL, NULL);
    z_view_keyexpr_t key;
    z_view_keyexpr_from_str_unchecked(&key, SCAN);
    z_owned_subscriber_t subscriber;
    if (z_declare_subscriber(z_loan(session), &subscriber, z_loan(key), z_move(closure), NULL) < 0)
        return fprintf(stderr, "cannot subscribe\n"), 1;
    for (int wait_ms = 0; exit_code < 0; usleep(10000), wait_ms -= 10) {
        if (!is_near || wait_ms > 0) continue;
        if (!press(z_loan(session))) return fprintf(stderr, "no connection\n"), 1;
        wait_ms = 1000; /* without an answer it presses again, which does no harm */
    }
    z_drop(z_move(subscriber));
    z_drop(z_move(session));
    return exit_code;
}
