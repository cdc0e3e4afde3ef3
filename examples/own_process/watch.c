/* A program of one's own in C, with zenoh-pico and JSON: it prints messages, and presses the e-stop.
 *
 *   cmake -S zenoh-pico -B build -DBUILD_EXAMPLES=OFF -DBUILD_TESTING=OFF -DBUILD_SHARED_LIBS=OFF \
 *         -DBATCH_UNICAST_SIZE=65535 -DFRAG_MAX_SIZE=4000000 && make -C build -j2
 *   cc -std=c11 -D_GNU_SOURCE -DZENOH_LINUX -I zenoh-pico/include -I build/include watch.c \
 *         build/lib/libzenohpico.a -lpthread -lrt -o watch
 *   ./watch tcp/127.0.0.1:7447 [estop]
 *
 * Both flags of cmake matter: without them zenoh-pico drops messages of more than 4000 bytes, such as
 * maps, without a word.
 */
#include <stdio.h>
#include <string.h>
#include <unistd.h>
#include <zenoh-pico.h>

static volatile int received = 0;

static void on_state(z_loaned_sample_t *sample, void *context) {
    (void)context;
    z_owned_slice_t payload;
    if (z_bytes_to_slice(z_sample_payload(sample), &payload) < 0) return;
    received++;
    if (received % 50 == 1)
        printf("robot/state: %zu bytes of MessagePack\n", z_slice_len(z_loan(payload)));
    z_drop(z_move(payload));
}

int main(int argc, char **argv) {
    if (argc < 2) return fprintf(stderr, "usage: watch ENDPOINT [estop]\n"), 2;
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
    z_closure(&closure, on_state, NULL, NULL);
    z_view_keyexpr_t key;
    z_view_keyexpr_from_str_unchecked(&key, "robot/state");
    z_owned_subscriber_t subscriber;
    if (z_declare_subscriber(z_loan(session), &subscriber, z_loan(key), z_move(closure), NULL) < 0)
        return fprintf(stderr, "cannot subscribe\n"), 1;
    for (int i = 0; i < 30 && received < 100; i++) usleep(100000);
    if (argc > 2 && strcmp(argv[2], "estop") == 0) {
        z_owned_bytes_t payload;
        z_bytes_copy_from_str(&payload, "{\"source\": \"watch.c\"}");
        z_put_options_t options;
        z_put_options_default(&options);
        z_owned_encoding_t encoding;
        z_encoding_from_str(&encoding, "application/json");
        options.encoding = z_move(encoding);
        z_view_keyexpr_from_str_unchecked(&key, "robot/estop");
        z_put(z_loan(session), z_loan(key), z_move(payload), &options);
        puts("e-stop sent");
        usleep(200000);
    }
    printf("%d states\n", received);
    z_drop(z_move(subscriber));
    z_drop(z_move(session));
    return received ? 0 : 1;
}
