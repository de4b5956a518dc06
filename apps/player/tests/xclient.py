"""What a file manager and a window manager tell a window of an X server: a dropped file (the XDND protocol, version 5), and to close. Needs python-xlib."""
import pathlib, time
from Xlib import X, display
from Xlib.protocol import event

PATIENCE = 20


def drop(server, window, path, at=(640, 400)):
    """Drops the file `path` on the window with the id `window` of the X server `server`. Returns whether the window took it."""
    connection = display.Display(server)
    atom = connection.intern_atom
    screen = connection.screen()
    source = screen.root.create_window(0, 0, 1, 1, 0, screen.root_depth)
    target = connection.create_resource_object("window", int(window))
    uri = (pathlib.Path(path).absolute().as_uri() + "\r\n").encode()
    source.set_selection_owner(atom("XdndSelection"), X.CurrentTime)
    kind = atom("text/uri-list")

    def tell(name, *words):
        data = (32, [source.id, *words, *[0] * (4 - len(words))])
        target.send_event(event.ClientMessage(window=target, client_type=atom(name), data=data))
        connection.flush()

    def answer(request):
        request.requestor.change_property(request.property, request.target, 8, uri)
        notify = event.SelectionNotify(time=request.time, requestor=request.requestor, selection=request.selection, target=request.target, property=request.property)
        request.requestor.send_event(notify)
        connection.flush()

    tell("XdndEnter", 5 << 24, kind)
    tell("XdndPosition", 0, at[0] << 16 | at[1], X.CurrentTime, atom("XdndActionCopy"))
    began, dropped = time.time(), False
    while time.time() - began < PATIENCE:
        if not connection.pending_events():
            time.sleep(0.02)
            continue
        found = connection.next_event()
        if found.type == X.SelectionRequest:
            answer(found)
        elif found.type == X.ClientMessage and found.client_type == atom("XdndStatus") and not dropped:
            if not found.data[1][1] & 1:
                return False
            dropped = True
            tell("XdndDrop", 0, X.CurrentTime)
        elif found.type == X.ClientMessage and found.client_type == atom("XdndFinished"):
            return True
    return False


def close(server, window):
    """Asks the window to close, as the button in its frame does."""
    connection = display.Display(server)
    target = connection.create_resource_object("window", int(window))
    words = [connection.intern_atom("WM_DELETE_WINDOW"), X.CurrentTime, 0, 0, 0]
    target.send_event(event.ClientMessage(window=target, client_type=connection.intern_atom("WM_PROTOCOLS"), data=(32, words)))
    connection.flush()
